"""The folders where copies of what was read from stores lie on this machine: see
`scenegen.stores.copies`.

A folder of copies is of one store and one manifest, and beside it lies a note of both. Like the
kernels', it serves only where nobody but this user may write. A whole copy is held against the
digest that the manifest has of it once, and again whenever it has changed.
"""

import hashlib
import json
import os
import stat
import tempfile
import time
from collections.abc import Collection, Mapping
from contextlib import closing, suppress
from functools import lru_cache
from pathlib import Path

from lidarsim.jit import folder_trouble, is_ours
from scenegen.errors import StoreError
from scenegen.stores import home_of, note_file, store_of
from scenegen.stores.copies import (
    MOST_BYTES,
    PART,
    ROOM,
    Copy,
    Note,
    alone,
    disk_told,
    root,
    stamp,
)

AT_A_TIME = 8
"""Files that are fetched at the same time, where all are needed."""
USED_S = 60.0
"""Seconds after which it is noted again that a copy was used."""


def keep(store: str, name: str, manifest: bytes) -> Path:
    """The folder of copies of what a manifest of this name and content lists at `store`, with the
    manifest in it.

    Raises StoreError, also where others may write to the folder.
    """
    parts = (hashlib.sha256(one).hexdigest()[:16] for one in (store.encode(), manifest))
    folder = root().joinpath(*parts)
    _check(folder)
    _put(folder / name, store, manifest)
    return folder


def note(folder: Path, store: str, files: Mapping[str, str]) -> None:
    """Note what a folder of copies is of: from now on its `files`, names with their SHA-256, can be
    fetched.

    Raises StoreError.
    """
    _put(note_file(folder), store, json.dumps(Note(store, files)._asdict()).encode())


def fetch(path: Path) -> None:
    """Have `path` be there and whole, if it is in a folder of copies and a file of the store.

    Raises StoreError where the store does not give it, or other bytes than the manifest lists, and
    FileNotFoundError where it has none.
    """
    if (copy := open_copy(path, MOST_BYTES)) is not None:
        with closing(copy):
            copy.fileno()


def open_copy(path: Path, tail_bytes: int) -> Copy | None:
    """A copy of which what is read is fetched, and so much of its end now; None where it is whole,
    or none of a store's. Raises as `fetch`."""
    folder = home_of(path.parent)
    about, name = note_of(folder), str(path.relative_to(folder))
    if about is None or name not in about.files or _is_whole(path, about.files[name]):
        return None
    path.parent.mkdir(exist_ok=True)
    with alone(path, about.store) as handle:
        if _is_whole(path, about.files[name]):
            return None
        copy = Copy(path, about, handle, tail_bytes)
    if not copy.whole:
        return copy
    with closing(copy):
        copy.fileno()  # which gives it its name
    return None


def _is_whole(path: Path, digest: str) -> bool:
    """Whether `path` is a file of ours with this SHA-256. It is read only if it changed since that
    was last seen."""
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or not is_ours(found) or found.st_mode & 0o022:
            return False
        if found.st_mtime_ns == found.st_size:
            if time.time() - found.st_atime > USED_S:
                with suppress(PermissionError):  # a root's, who looks after it
                    os.utime(path, ns=(time.time_ns(), found.st_size))
            return True
        with open(path, "rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != digest:
                return False
            stamp(file.fileno())
    except OSError:
        return False
    return True


def fetch_all(folder: Path, names: Collection[str]) -> None:
    """Have all of these be in a folder of copies. Raises StoreError, also for one that is not
    there."""

    def one(name: str) -> None:
        try:
            fetch(folder / name)
        except FileNotFoundError:
            raise StoreError(
                f"{folder / name}: is missing at the store, though it is listed"
            ) from None

    from concurrent.futures import ThreadPoolExecutor  # importing it takes time

    with ThreadPoolExecutor(AT_A_TIME) as pool:
        list(pool.map(one, names))
    if lost := [name for name in names if not (folder / name).exists()]:
        raise StoreError(
            f"{folder / lost[0]}: made room for others, though all are needed; raise {ROOM}"
        )


def note_of(folder: Path) -> Note | None:
    """What a folder of copies is of; None for any other, whatever lies beside it: a stranger's has
    no say in what is asked of the network."""
    folder = Path(os.path.realpath(folder))
    if folder.parent.parent != root() or not note_file(folder).is_file():
        return None
    try:
        return _noted(folder)
    except (ValueError, TypeError):  # damaged: `note` writes it again
        return None


def bytes_in(folder: Path) -> int:
    """Bytes of the files in a dataset's folder, or of those that a folder of copies is of, fetched
    or not. Raises StoreError."""
    found = (path for path in (*folder.glob("*"), *folder.glob("*-*x/*")) if path.is_file())
    there = {str(path.relative_to(folder)): path.stat().st_size for path in found}
    if (about := note_of(folder)) is not None:
        there = {name: size for name, size in there.items() if not name.endswith(PART)} | {
            item.name: item.bytes
            for item in store_of(about.store).list()
            if item.name in about.files
        }
    return sum(there.values())


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
        with disk_told(store):
            handle, draft = tempfile.mkstemp(prefix=".", suffix=".tmp", dir=path.parent)
            try:
                with open(handle, "wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
                Path(draft).replace(path)
            finally:
                Path(draft).unlink(missing_ok=True)
