"""The folder that is published: put together beside its final place, hashed, then moved there
whole."""

import contextlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from scenegen.dataset import manifest
from scenegen.dataset.locate import file_sha256
from scenegen.errors import DatasetError, PublishError
from scenegen.files import disk_error, draft_of, remove_drafts, sync_folder, write_whole
from scenegen.run import undone_if_stopped

SUMS = "SHA256SUMS"
"""Digest and name of every other file, as sha256sum writes and checks them."""


def check_out(dataset: Path, out: Path) -> None:
    """Raise PublishError where `out` cannot take the folder: it is the dataset, or holds what
    publish did not make."""
    if out.exists() and not out.is_dir():
        raise PublishError(f"--out {out}: is there, and not a folder; give another name")
    there, here = out.resolve(), dataset.resolve()
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
        there, here = (source / name).resolve(), draft / name
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
