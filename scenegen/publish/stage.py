"""From a dataset to the folder that is published, on one screen."""

import datetime
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.locate import REPOSITORY, REVISION, file_sha256, listed_files
from scenegen.dataset.read import Dataset
from scenegen.errors import PublishError
from scenegen.files import write_whole
from scenegen.inspect import inspect
from scenegen.publish.card import card
from scenegen.publish.croissant import croissant
from scenegen.publish.folder import check_out, drafted, former_date, seal, take
from scenegen.publish.licence import find_licence
from scenegen.publish.lock import LOCK, environment_lock
from scenegen.publish.pictures import draw_sample
from scenegen.publish.publication import Publication
from scenegen.publish.regenerate import RECIPE, check_recipe, command, recipe_text

MOST_FILES = 300
"""Of a published folder: the Hub, and people, work badly with more."""
SHOWN = 4
"""Samples with a picture."""
_BESIDES = 12
"""Files at most besides shards and archives, pictures included."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is to be published, and as what."""

    dataset: Path
    repository: str
    """user/name on the Hub."""
    out: Path
    """Where the folder is put together."""
    tag: str | None = None
    """The revision's name; None: the format's version and the digest's beginning, so that it names the content."""
    licence: str = "CC-BY-4.0"
    """SPDX name."""
    commit: str = "unknown"
    """Of scenegen's own checkout."""

    def __post_init__(self) -> None:
        if not REPOSITORY.fullmatch(self.repository) or re.search(r"--|\.\.|[.-](/|$)|\.git$", self.repository):
            raise PublishError(f"--repo {self.repository}: expected user/name, such as ada/pillar")
        if self.tag is not None and (not REVISION.fullmatch(self.tag) or ".." in self.tag):
            raise PublishError(f"--tag {self.tag}: expected letters, digits and . _ - /, such as v1")


@dataclass(frozen=True, kw_only=True)
class Staged:
    """A folder ready to go."""

    folder: Path
    repository: str
    tag: str
    files: dict[str, int]
    """Name to size in bytes."""
    digest: str


def examine(request: Request) -> Dataset:
    """The dataset, if it can be published as asked: everything that can be refused at once is refused here.

    Raises DatasetError, PublishError.
    """
    find_licence(request.licence)
    dataset = Dataset(request.dataset)
    check_out(request.dataset, request.out)
    files = len(listed_files(request.dataset, str(request.dataset))) + _BESIDES
    if files > MOST_FILES:
        samples = sum(shard["samples"] for shard in dataset.manifest["shards"])
        room = (MOST_FILES - _BESIDES) // 2 - len(SPLITS)
        raise PublishError(
            f"{request.dataset}: {files} files, more than the {MOST_FILES} that are published; generate it again with "
            f"--shard-samples {-(-samples // room // 100) * 100 + 100}, which changes no sample"
        )
    if not (dataset.manifest.get("counts") and dataset.manifest.get("shard_samples")):
        raise PublishError(f"{request.dataset}: {manifest.NAME} names no counts, so it cannot say how to make it again")
    check_recipe(dataset, recipe_text(dataset.manifest))
    return dataset


def stage(request: Request, checks: tuple[tuple[str, str], ...]) -> Staged:
    """Put the folder together: shards and worlds, pictures, card, Croissant, recipe, lock, licence, and checksums.

    `checks` are names and details of what the dataset passed. The same request gives the same bytes. Raises
    DatasetError, PublishError.
    """
    dataset = examine(request)
    found, digest = dataset.manifest, str(dataset.manifest["digest"])
    files = listed_files(request.dataset, str(request.dataset))
    content = (request.dataset / manifest.NAME).read_bytes()
    tag = request.tag or f"v{found['version']}-{digest[:8]}"
    name = request.repository.partition("/")[2]
    with drafted(request.out) as draft:
        take(request.dataset, draft, files)
        write_whole(draft / manifest.NAME, content)
        it = Publication(
            repository=request.repository,
            tag=tag,
            licence=find_licence(request.licence),
            date=former_date(request.out, content) or datetime.datetime.now(datetime.UTC).date().isoformat(),
            manifest=found,
            lidar=dataset.lidar,
            statistics=inspect(draft),
            command=command(found, name),
            lock=environment_lock(found["software"], request.commit),
            checks=checks,
            pictures=_draw(dataset, draft),
        )
        sums = {**files, manifest.NAME: file_sha256(draft / manifest.NAME)}
        texts = {
            "README.md": card(it),
            "croissant.json": croissant(it, sums),
            "LICENSE": it.licence.text(request.repository.partition("/")[0]),
            LOCK: it.lock,
            RECIPE: recipe_text(found),
        }
        for file, text in texts.items():
            write_whole(draft / file, text.encode())
        sizes = seal(draft, sums)
    return Staged(folder=request.out, repository=request.repository, tag=tag, files=sizes, digest=digest)


def _draw(dataset: Dataset, draft: Path) -> tuple[tuple[str, str], ...]:
    """Pictures of a few training samples, evenly spread: name and caption of each."""
    (draft / "pictures").mkdir()
    split: Any = next(found for name in SPLITS if len(found := dataset.split(name)))
    pictures = []
    for number, index in enumerate(np.unique(np.linspace(0, len(split) - 1, min(SHOWN, len(split))).astype(int))):
        sample = split[int(index)]
        name = f"pictures/{split.name}-{number}.png"
        write_whole(draft / name, draw_sample(sample, dataset.grid.truncation_m))
        pictures.append((name, f"{split.name} sample {index} (world {sample.world}, viewpoint {sample.viewpoint})"))
    return tuple(pictures)
