"""From a dataset to the folder that is published: put together beside its final place, hashed, then
moved there whole."""

import contextlib
import datetime
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.locate import REPOSITORY, REVISION, file_sha256
from scenegen.dataset.read import Dataset
from scenegen.display.blocks import draw_sample
from scenegen.display.inspect import inspect
from scenegen.display.look import looks, spread
from scenegen.display.page import check_grid, page
from scenegen.errors import DatasetError, PublishError
from scenegen.files import disk_error, draft_of, real_path, remove_drafts, sync_folder, write_whole
from scenegen.run import undone_if_stopped
from scenegen.share.card import card
from scenegen.share.croissant import croissant
from scenegen.share.licence import USUAL, find_licence
from scenegen.share.publication import LOCK, Publication, environment_lock
from scenegen.share.regenerate import check_kind, check_source, command, source_file

SUMS = "SHA256SUMS"
"""Digest and name of every other file, as sha256sum writes and checks them."""

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
    if dataset.manifest.sources and all(one.digest is None for one in dataset.manifest.sources):
        raise PublishError(
            f"{request.dataset}: is a mixture of several kinds, which has no card yet; generate "
            f"and publish a dataset of each kind"
        )
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
    split = _first_split(dataset)
    pictures = []
    for number, index in enumerate(spread(dataset, split, SHOWN)):
        sample = dataset.split(split)[index]
        name = f"pictures/{split}-{number}.png"
        write_whole(draft / name, draw_sample(sample, dataset.grid.truncation_m))
        about = f"world {sample.world}, viewpoint {sample.viewpoint}"
        pictures.append((name, f"{split} sample {index} ({about})"))
    return tuple(pictures)


def _first_split(dataset: Dataset) -> str:
    return next(name for name in SPLITS if len(dataset.split(name)))


def _write_page(dataset: Dataset, draft: Path) -> str:
    """Write the page to look at some samples with. Returns its name; "" for grids that no browser
    takes."""
    split = _first_split(dataset)
    try:
        check_grid(dataset.grid)
    except DatasetError:
        return ""
    shown, notes = looks(dataset, split, spread(dataset, split, ON_PAGE))
    write_whole(
        draft / PAGE, page(shown, title=f"{dataset.manifest.kind}, {split}", notes=notes).encode()
    )
    return PAGE


def check_out(dataset: Path, out: Path) -> None:
    """Raise PublishError where `out` cannot take the folder: it is the dataset, or holds what
    publish did not make."""
    if out.exists() and not out.is_dir():
        raise PublishError(f"--out {out}: is there, and not a folder; give another name")
    there, here = real_path(out), real_path(dataset)
    if there == here or there.is_relative_to(here) or here.is_relative_to(there):
        raise PublishError(f"--out {out}: overlaps the dataset; choose a place beside it")
    _check_foreign(out)


def _check_foreign(out: Path) -> None:
    foreign = sorted(foreign_files(out))
    if foreign:
        raise PublishError(
            f"--out {out}: holds {foreign[0]}, which publish did not put there; choose another "
            f"folder"
        )


def foreign_files(out: Path) -> set[str]:
    """What is in `out`, a folder of a former run or none, that its own list does not name; all of
    it where no former run made the folder."""
    if not out.is_dir():
        return set()
    there = {
        str(path.relative_to(out))
        for path in out.rglob("*")
        if path.is_symlink() or not path.is_dir()
    }
    with contextlib.suppress(DatasetError, OSError, UnicodeDecodeError):
        manifest.read(out)
        there -= {
            line.partition("  ")[2]
            for line in (out / SUMS).read_text(encoding="utf-8").splitlines()
        }
        there.discard(SUMS)
    return there


@contextlib.contextmanager
def drafted(out: Path) -> Iterator[Path]:
    """A folder to fill, which takes the place of `out` once all went well, and vanishes otherwise.

    Raises DatasetError where the disk refuses, PublishError where something foreign came into `out`
    meanwhile.
    """
    draft, former = draft_of(out), draft_of(out)

    def clear() -> None:
        if former.exists() and not out.exists():
            former.rename(out)
        for stale in (draft, former):
            shutil.rmtree(stale, ignore_errors=True)

    with undone_if_stopped(clear):
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            remove_drafts(out.parent, out.name)
            draft.mkdir()
            yield draft
            sync_folder(draft)
            _check_foreign(out)
            if out.exists():
                out.rename(former)
            draft.rename(out)
            sync_folder(out.parent)
        except OSError as error:
            raise disk_error(Path(error.filename or out), error) from None
        finally:
            clear()


def take(source: Path, draft: Path, names: Mapping[str, str]) -> None:
    """Put the files `names` (each with its SHA-256) of a dataset into `draft`: as hard links, or as
    copies elsewhere.

    Raises PublishError for one that is not what its digest says.
    """

    def take_one(name: str) -> None:
        there, here = real_path(source / name), draft / name
        try:
            os.link(there, here)
        except OSError:  # another disk, or a file system or owner that does not allow it
            shutil.copyfile(there, here)
        if file_sha256(here) != names[name]:
            raise PublishError(
                f"{source / name}: is not the file that {manifest.NAME} lists; generate it again"
            )

    for name in names:
        if not (source / name).is_file():
            raise PublishError(
                f"{source / name}: is missing, though {manifest.NAME} lists it; generate it again"
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
    try:
        if (out / manifest.NAME).read_bytes() == content:
            return str(
                json.loads((out / "croissant.json").read_text(encoding="utf-8"))["datePublished"]
            )
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return None
