"""From a dataset to the folder that is published, on one screen."""

import datetime
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.locate import REPOSITORY, REVISION, file_sha256
from scenegen.dataset.read import Dataset
from scenegen.display.blocks import draw_sample
from scenegen.display.inspect import inspect
from scenegen.display.look import looks, spread
from scenegen.display.page import check_grid, page
from scenegen.errors import DatasetError, PublishError
from scenegen.files import write_whole
from scenegen.share.card import card
from scenegen.share.croissant import croissant
from scenegen.share.folder import check_out, drafted, former_date, seal, take
from scenegen.share.licence import USUAL, find_licence
from scenegen.share.publication import LOCK, Publication, environment_lock
from scenegen.share.regenerate import check_kind, check_source, command, source_file

MOST_FILES = 300
"""The most files of a published folder: the Hub, and people, work badly with more."""
SHOWN = 4
"""How many samples are drawn as pictures."""
PAGE, ON_PAGE = "look.html", 12
"""The page to look at samples with, and how many it shows."""
_BESIDES = 12
"""The most files that a published folder holds besides shards and archives."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """What is to be published, and as what."""

    dataset: Path
    repository: str
    """The repository on the Hub, as user/name."""
    out: Path
    """Where the folder is put together."""
    tag: str | None = None
    """The name of the revision. None stands for the format's version and the beginning of the
    digest, which names the content."""
    licence: str = USUAL
    """The SPDX name of the data's licence."""
    kind: str | None = None
    """The dataset's kind, where its own module may be imported: a user's own, as
    ``module:Class``."""
    commit: str = "unknown"
    """The commit of the scenegen checkout that publishes."""

    def __post_init__(self) -> None:
        if not REPOSITORY.fullmatch(self.repository) or re.search(
            r"--|\.\.|[.-](/|$)|\.git$", self.repository
        ):
            raise PublishError(f"--repo {self.repository}: expected user/name, such as ada/pillar")
        if self.tag is not None and (not REVISION.fullmatch(self.tag) or ".." in self.tag):
            raise PublishError(
                f"--tag {self.tag}: expected letters, digits and . _ - /, such as v1"
            )


@dataclass(frozen=True, kw_only=True)
class Staged:
    """A folder ready to go."""

    folder: Path
    repository: str
    tag: str
    files: dict[str, int]
    """Name of every file to its size in bytes."""
    digest: str


def examine(request: Request) -> Dataset:
    """Open the dataset, and refuse at once everything that can be refused before its samples are
    read.

    Raises DatasetError, PublishError.
    """
    find_licence(request.licence)
    dataset = Dataset(request.dataset)
    check_out(request.dataset, request.out)
    if dataset.manifest.sources:
        raise PublishError(
            f"{request.dataset}: its samples were made for other datasets, and no one command "
            f"makes them again; "
            "publish those, and say how they were merged or taken"
        )
    files = len(dataset.manifest.files) + _BESIDES
    if files > MOST_FILES:
        samples = sum(shard.samples for shard in dataset.manifest.shards)
        room = (MOST_FILES - _BESIDES) // 2 - len(SPLITS)
        raise PublishError(
            f"{request.dataset}: {files} files, more than the {MOST_FILES} that are published; "
            f"generate it again with "
            f"--shard-samples {-(-samples // room // 100) * 100 + 100}, which changes no sample"
        )
    if dataset.manifest.rescan is None:
        check_kind(dataset.manifest.kind, request.kind)
    check_source(dataset, *source_file(dataset.manifest))
    return dataset


def stage(request: Request, checks: tuple[tuple[str, str], ...]) -> Staged:
    """Put the folder together: shards and worlds, pictures, card, Croissant, recipe, lock, licence,
    and checksums.

    `checks` are names and details of what the dataset passed. The same request gives the same
    bytes. Raises DatasetError, PublishError.
    """
    dataset = examine(request)
    found, digest = dataset.manifest, str(dataset.manifest.digest)
    files = found.files
    content = (request.dataset / manifest.NAME).read_bytes()
    tag = request.tag or f"v{manifest.VERSION}-{digest[:8]}"
    name = request.repository.partition("/")[2]
    with drafted(request.out) as draft:
        take(request.dataset, draft, files)
        write_whole(draft / manifest.NAME, content)
        it = Publication(
            repository=request.repository,
            tag=tag,
            licence=find_licence(request.licence),
            date=former_date(request.out, content)
            or datetime.datetime.now(datetime.UTC).date().isoformat(),
            manifest=found,
            statistics=inspect(draft),
            command=command(found, name),
            lock=environment_lock(found.software, request.commit),
            checks=checks,
            pictures=_draw(dataset, draft),
            page=_write_page(dataset, draft),
        )
        sums = {**files, manifest.NAME: file_sha256(draft / manifest.NAME)}
        texts = {
            "README.md": card(it),
            "croissant.json": croissant(it, sums),
            "LICENSE": it.licence.text(request.repository.partition("/")[0]),
            LOCK: it.lock,
            **dict([source_file(found)]),
        }
        for file, text in texts.items():
            write_whole(draft / file, text.encode())
        sizes = seal(draft, sums)
    return Staged(
        folder=request.out, repository=request.repository, tag=tag, files=sizes, digest=digest
    )


def _draw(dataset: Dataset, draft: Path) -> tuple[tuple[str, str], ...]:
    """Draw a few evenly spread samples. Returns the name and the caption of each picture."""
    (draft / "pictures").mkdir()
    split: Any = next(found for name in SPLITS if len(found := dataset.split(name)))
    pictures = []
    for number, index in enumerate(
        np.unique(np.linspace(0, len(split) - 1, min(SHOWN, len(split))).astype(int))
    ):
        sample = split[int(index)]
        name = f"pictures/{split.name}-{number}.png"
        write_whole(draft / name, draw_sample(sample, dataset.grid.truncation_m))
        pictures.append(
            (
                name,
                f"{split.name} sample {index} (world {sample.world}, viewpoint {sample.viewpoint})",
            )
        )
    return tuple(pictures)


def _write_page(dataset: Dataset, draft: Path) -> str:
    """Write the page to look at some samples with. Returns its name; "" for grids that no browser
    takes."""
    split = next(name for name in SPLITS if len(dataset.split(name)))
    try:
        check_grid(dataset.grid)
    except DatasetError:
        return ""
    shown, notes = looks(dataset, split, spread(dataset, split, ON_PAGE))
    write_whole(
        draft / PAGE, page(shown, title=f"{dataset.manifest.kind}, {split}", notes=notes).encode()
    )
    return PAGE
