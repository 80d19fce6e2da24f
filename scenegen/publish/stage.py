"""From a dataset to the folder that is published: put together beside its final place, hashed, then
moved there whole.
"""

import datetime
import json
import os
import re
import shutil
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from scenegen import SPLITS, __version__
from scenegen.base.errors import DatasetError, PublishError, raised_as, short
from scenegen.base.executors import commit
from scenegen.base.files import make_parent, real_path, whole_folder, write_whole
from scenegen.dataset import manifest
from scenegen.dataset.like import check_same
from scenegen.dataset.locate import REPOSITORY, REVISION, file_sha256
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME, VERSION
from scenegen.dataset.selection import kept_measures, measures_file
from scenegen.publish import LICENCES, USUAL
from scenegen.publish.card import card, croissant, facts
from scenegen.view.inspect import inspect
from scenegen.view.look import evenly, looks
from scenegen.view.page import page
from scenegen.worlds.kinds import KINDS

SUMS = "SHA256SUMS"
"""Digest and name of every other file, as sha256sum writes and checks them."""

MOST_FILES = 100_000
"""The most shards and archives that are published: of a repository with more files, the Hub says
that it works badly."""
MOST_LISTED = 300
"""The most files of which Croissant has an entry each; of more, the manifest has the digests."""
SHOWN = 4
"""How many samples are drawn as pictures."""
PAGE, ON_PAGE = "look.html", 12
"""The page to look at samples with, and how many it shows."""
ABOVE = """Above, from left to right: returns, observed voxels, occupied voxels, in the map's box; \
below: three levels of the distances to the nearest occupied voxel. The red ball is the sensor."""
LICENCE = """This dataset, published by {owner}, is licensed under

    {licence}
    SPDX-License-Identifier: {spdx}
    {licence_url}

The full text at this address is what counts. The files are provided as they are, without any \
warranty.
"""


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
    """The SPDX name of the data's licence, in any case."""
    kind: str | None = None
    """The dataset's kind, where its own module may be imported: a user's own, as
    ``module:Class``."""

    def __post_init__(self) -> None:
        known = {name.lower(): name for name in LICENCES}
        licence = known.get(self.licence.lower())
        if licence is None:
            raise PublishError(f"--licence {self.licence}: expected one of {', '.join(LICENCES)}")
        object.__setattr__(self, "licence", licence)
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
    dataset = Dataset(request.dataset)
    check_out(request.dataset, request.out)
    if (files := len(dataset.manifest.files)) > MOST_FILES:
        raise PublishError(
            f"{request.dataset}: {files} files, more than the {MOST_FILES} that are published; "
            "generate it again with a larger --shard-samples, which changes no sample"
        )
    made = dataset.manifest
    if made.like is None:
        _check_kind(made.kind, request.kind)
    if not made.noise_is_ours:
        raise PublishError(
            f"its noise, {short(made.noise_stages)}, has stages that are none of scenegen's own, "
            "which are not imported; it cannot be said whether its command makes the same ranges "
            "again"
        )
    if request.kind is not None:
        made = manifest.parse(manifest.read_content(request.dataset), request.dataset, request.kind)
    with raised_as(PublishError, of=DatasetError):
        check_same(made, str(request.dataset))
    return dataset


def _check_kind(kind: str, named: str | None) -> None:
    """Raise PublishError for a dataset of a kind whose worlds only a module of somebody's own can
    draw, unless the user `named` it: no module is imported because a manifest names it."""
    if kind != "scene" and kind not in KINDS.builtin and kind != named:
        raise PublishError(
            f"the dataset's kind, {short(kind)}, is none of scenegen's own, and only its module "
            "can say whether the recipe makes the same worlds again; give --kind with its name to "
            "have it imported"
        )


def _environment_lock(made: Manifest) -> str:
    """A requirements file of what the dataset's numbers depend on, in the versions that made it.

    scenegen itself stands in a comment: it is installed from its own source, and a line here would
    ask a package index for whatever bears its name there.
    """
    versions = dict(made.software)
    lines = [f"# scenegen {versions.pop('scenegen', __version__)}, published with {__version__}"]
    lines.append(f"# {versions.pop('machine', 'unknown machine')}, commit {commit()}")
    lines += [f"{name}=={version}" for name, version in sorted(versions.items())]
    return "\n".join([*lines, ""])


def stage(request: Request, checks: tuple[tuple[str, str], ...]) -> Staged:
    """Put the folder together: shards and worlds, pictures, card, Croissant, recipe, lock, licence,
    and checksums.

    `checks` are names and details of what the dataset passed. The same request gives the same
    bytes. Raises DatasetError, PublishError.
    """
    dataset = examine(request)
    found, digest = dataset.manifest, str(dataset.manifest.digest)
    content = (request.dataset / NAME).read_bytes()
    tag = request.tag or f"v{VERSION}-{digest[:8]}"
    with whole_folder(request.out, partial(check_out, request.dataset)) as draft:
        take(request.dataset, draft, found.files)
        write_whole(draft / NAME, content)
        if kept_measures(dataset):
            figures = measures_file(dataset)
            write_whole(draft / figures.name, figures.read_bytes())
        listed = {NAME: file_sha256(draft / NAME)}
        sums = found.files | listed
        told = inspect(Dataset(draft))
        given = facts(
            found,
            told,
            request.repository,
            request.licence,
            tag=tag,
            date=former_date(request.out, content)
            or datetime.datetime.now(datetime.UTC).date().isoformat(),
            checks=checks,
            pictures=_draw(dataset, draft),
        )
        texts = {
            "README.md": card(given),
            "croissant.json": croissant(
                given, found, told, sums if len(sums) <= MOST_LISTED else listed
            ),
            "LICENSE": LICENCE.format(spdx=request.licence, **given),
            "requirements.lock.txt": _environment_lock(found),
        }
        for file, text in texts.items():
            write_whole(draft / file, text.encode())
        sizes = seal(draft, sums)
    return Staged(
        folder=request.out, repository=request.repository, tag=tag, files=sizes, digest=digest
    )


def _draw(dataset: Dataset, draft: Path) -> str:
    """Draw a few evenly spread samples, where matplotlib is installed, and write a page of some
    more, unless no browser takes such grids. Returns what shows them in the card."""
    split = next(name for name in SPLITS if len(dataset.split(name)))
    shown, notes = looks(dataset, split, evenly(len(dataset.split(split)), ON_PAGE))
    parts = []
    if find_spec("matplotlib") is not None:
        from scenegen.view.panels import to_bytes
        from scenegen.view.pictures import draw_sample

        (draft / "pictures").mkdir()
        for number, look in enumerate(
            looks(dataset, split, evenly(len(dataset.split(split)), SHOWN))[0]
        ):
            name = f"pictures/{split}-{number}.png"
            write_whole(draft / name, to_bytes(draw_sample(look), ".png"))
            parts.append(f"![{look.name}]({name})")
        parts.append(ABOVE)
    with suppress(DatasetError):  # a grid that is too large
        text = page(shown, title=f"{dataset.kind}, {split}", notes=notes)
        write_whole(draft / PAGE, text.encode())
        parts.append(
            f"Samples in three dimensions: download [{PAGE}]({PAGE}), and open it in a browser."
        )
    return "\n\n".join(parts)


def check_out(dataset: Path, out: Path) -> None:
    """Raise PublishError where `out` cannot take the folder: it is the dataset, or holds what its
    own list, of a former run, does not name."""
    if out.exists() and not out.is_dir():
        raise PublishError(f"--out {out}: is there, and not a folder; give another name")
    there, here = real_path(out), real_path(dataset)
    if there.is_relative_to(here) or here.is_relative_to(there):
        raise PublishError(f"--out {out}: overlaps the dataset; choose a place beside it")
    files = (path for path in out.rglob("*") if path.is_symlink() or not path.is_dir())
    foreign = {str(path.relative_to(out)) for path in files}
    with suppress(DatasetError, OSError, UnicodeDecodeError):
        manifest.read_content(out)
        foreign -= {SUMS, *read_sums(out)}
    if foreign:
        raise PublishError(
            f"--out {out}: holds {min(foreign)}, which publish did not put there; choose another "
            "folder"
        )


def read_sums(folder: Path) -> dict[str, str]:
    """The digests that `SUMS` lists, by the files' names."""
    lines = (folder / SUMS).read_text(encoding="utf-8").splitlines()
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def take(source: Path, draft: Path, names: Mapping[str, str]) -> None:
    """Put the files `names` (each with its SHA-256) of a dataset into `draft`: as hard links, or as
    copies elsewhere.

    Raises PublishError for one that is not what its digest says.
    """

    def take_one(name: str) -> None:
        there, here = real_path(source / name), draft / name
        make_parent(here)
        if there.is_file():
            try:
                os.link(there, here)
            except OSError:  # another disk, or a file system or owner that does not allow it
                shutil.copyfile(there, here)
        if not there.is_file() or file_sha256(here) != names[name]:
            raise PublishError(
                f"{source / name}: is not the file that {NAME} lists; generate it again"
            )

    with ThreadPoolExecutor() as pool:
        list(pool.map(take_one, names))


def seal(draft: Path, known: Mapping[str, str]) -> dict[str, int]:
    """Write `SUMS` over all files of `draft`, those in `known` with the SHA-256 given there.
    Returns name to size."""
    names = sorted(str(path.relative_to(draft)) for path in draft.rglob("*") if path.is_file())
    lines = [f"{known.get(name) or file_sha256(draft / name)}  {name}\n" for name in names]
    write_whole(draft / SUMS, "".join(lines).encode())
    return {name: (draft / name).stat().st_size for name in [*names, SUMS]}


def former_date(out: Path, content: bytes) -> str | None:
    """The date of publication in the folder `out`, if that folder publishes the dataset with the
    manifest `content`.

    A run that goes on after a stop takes this date, so that it sends the same files as the stopped
    one."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        if (out / NAME).read_bytes() == content:
            return str(json.loads((out / "croissant.json").read_bytes())["datePublished"])
    return None
