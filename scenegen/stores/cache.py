"""Copies of what was read from stores, in a folder of this machine: fetched when first opened, and
held against the digest that the manifest has of each, once and whenever one has changed.

A folder of copies is of one store and one manifest, and beside it lies a note of both. Like the
kernels', it serves only where nobody but this user may write.
"""

import hashlib
import json
import os
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import IO, NamedTuple

from lidarsim.jit import cache_root, folder_trouble, is_ours
from scenegen.errors import StoreError, printable
from scenegen.stores import home_of, note_file, store_of

AT_A_TIME = 8
"""Files that are fetched at the same time, where all are needed."""
STALE_S = 24 * 3600.0
"""Age after which a copy that was never finished counts as left behind, seconds."""


class Note(NamedTuple):
    """What a folder of copies is of."""

    store: str
    files: Mapping[str, str]
    """Every file that the manifest lists, with its SHA-256."""


def keep(store: str, name: str, manifest: bytes) -> Path:
    """The folder of copies of what a manifest of this name and content lists at `store`, with the
    manifest in it.

    Raises StoreError, also where others may write to the folder.
    """
    parts = (hashlib.sha256(one).hexdigest()[:16] for one in (store.encode(), manifest))
    folder = _root().joinpath(*parts)
    _check(folder)
    _put(folder / name, store, manifest)
    for draft in folder.glob(".*.tmp"):
        with suppress(FileNotFoundError):
            if time.time() - draft.lstat().st_mtime > STALE_S:
                draft.unlink()
    return folder


def note(folder: Path, store: str, files: Mapping[str, str]) -> None:
    """Note what a folder of copies is of: from now on its `files`, names with their SHA-256, can be
    fetched.

    Raises StoreError.
    """
    _put(note_file(folder), store, json.dumps(Note(store, files)._asdict()).encode())


@contextmanager
def _draft(path: Path, store: str) -> Iterator[IO[bytes]]:
    """A file that takes the place of `path` when the block ends well. Raises StoreError where the
    disk refuses."""
    try:
        handle, draft = tempfile.mkstemp(prefix=".", suffix=".tmp", dir=path.parent)
        try:
            with open(handle, "w+b") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            Path(draft).replace(path)
        finally:
            Path(draft).unlink(missing_ok=True)
    except FileNotFoundError:
        raise  # the store's: it has no such object
    except OSError as error:
        raise StoreError(
            f"{printable(error)}: copies of {store} go there; free some space, or name another "
            "folder by SCENEGEN_CACHE"
        ) from None


def fetch(path: Path) -> bool:
    """Have `path` be there and whole, if it is in a folder of copies and a file of the store;
    whether it now is.

    Raises StoreError where the store does not give it, or other bytes than the manifest lists.
    """
    folder = home_of(path.parent)
    about, name = note_of(folder), str(path.relative_to(folder))
    if about is None or name not in about.files:
        return False
    if _is_whole(path, about.files[name]):
        return True
    path.parent.mkdir(exist_ok=True)
    try:
        with _draft(path, about.store) as file:
            store_of(about.store).read(name, file, 1 << 62)
            file.seek(0)
            if _sum(file) != about.files[name]:
                raise StoreError(
                    f"{about.store}/{name}: is not the file that the manifest lists; if a run "
                    "goes on there, wait for its end and give the same command again; else "
                    "generate the dataset again"
                )
            _stamp(file.fileno())
    except FileNotFoundError:
        return False
    return True


def _is_whole(path: Path, digest: str) -> bool:
    """Whether `path` is a file of ours with this SHA-256. It is read only if it changed since that
    was last seen."""
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or not is_ours(found) or found.st_mode & 0o022:
            return False
        if found.st_mtime_ns == found.st_size:
            return True
        with open(path, "rb") as file:
            if _sum(file) != digest:
                return False
            _stamp(file.fileno())
    except OSError:
        return False
    return True


def _sum(file: IO[bytes]) -> str:
    return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]


def _stamp(handle: int) -> None:
    """Note that a file is the one listed: its time of change becomes its size, in nanoseconds,
    until it changes."""
    with suppress(OSError):  # a root's copy, that this user may only read
        os.utime(handle, ns=(time.time_ns(), os.fstat(handle).st_size))


def fetch_all(folder: Path, names: Iterable[str]) -> None:
    """Have all of these be in a folder of copies. Raises StoreError, also for one that is not
    there."""

    def one(name: str) -> None:
        if not fetch(folder / name):
            raise StoreError(f"{folder / name}: is missing at the store, though it is listed")

    from concurrent.futures import ThreadPoolExecutor  # importing it takes time

    with ThreadPoolExecutor(AT_A_TIME) as pool:
        list(pool.map(one, names))


def note_of(folder: Path) -> Note | None:
    """What a folder of copies is of; None for any other, whatever lies beside it: a stranger's has
    no say in what is asked of the network."""
    folder = Path(os.path.realpath(folder))
    if folder.parent.parent != _root() or not note_file(folder).is_file():
        return None
    try:
        return _noted(folder)
    except (ValueError, TypeError):  # damaged: `note` writes it again
        return None


def bytes_in(folder: Path) -> int:
    """Bytes of the files in a dataset's folder, or of those that a folder of copies is of, fetched
    or not. Raises StoreError."""
    found = (item for part in (folder, *folder.glob("*-*x/")) for item in os.scandir(part))
    there = {item.path: item.stat().st_size for item in found if item.is_file()}
    there = {path.removeprefix(f"{folder}/"): size for path, size in there.items()}
    if (about := note_of(folder)) is not None:
        there |= {
            item.name: item.bytes
            for item in store_of(about.store).list()
            if item.name in about.files
        }
    return sum(there.values())


def _root() -> Path:
    return cache_root() / "scenegen" / "places"


@lru_cache(maxsize=8)
def _noted(folder: Path) -> Note:
    _check(folder)
    return Note(**json.loads(note_file(folder).read_bytes()))


def _check(folder: Path) -> None:
    if trouble := folder_trouble(folder):
        raise StoreError(
            f"{trouble}: copies of datasets go there; see to it, or name another folder by "
            "SCENEGEN_CACHE"
        )


def _put(path: Path, store: str, content: bytes) -> None:
    """Have `content` be at `path`, which is written only where it is not."""
    if not (path.is_file() and path.read_bytes() == content):
        with _draft(path, store) as file:
            file.write(content)
