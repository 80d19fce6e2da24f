"""Mirrors: folders of this machine in which the files of a store's dataset come to lie.

A mirror is of one store and one manifest, and beside it lies a note of both. A file is fetched when
it is first opened, as a whole, and checked against the manifest's SHA-256; from then on it is a
file like any other. Like the kernels', a mirror serves only if nobody but this user may write to
it.
"""

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from lidarsim.jit import cache_root, folder_trouble
from scenegen.base.errors import BrokenError, StoreError, printable
from scenegen.base.files import disk_told, whole, write_whole
from scenegen.base.stores import Store

AT_A_TIME = 8
"""Files that are fetched at the same time."""
ROOM = "SCENEGEN_CACHE_GB"
"""The environment variable for the gigabytes that mirrors may take. By default they take at most
half of what the disk has for them."""


class Mirror(NamedTuple):
    """The store that a mirror is of."""

    url: str
    files: Mapping[str, str]
    """The names of the manifest's files, with their SHA-256."""


def mirror_root() -> Path:
    """Where mirrors lie, each in a folder of a folder."""
    return cache_root() / "scenegen" / "places"


def make_mirror(store: Store, name: str, manifest: bytes) -> Path:
    """Make the mirror for a manifest of this name and content, which is put into it; its folder.
    Raises StoreError, also if others may write to the folder."""
    digests = (hashlib.sha256(text).hexdigest()[:16] for text in (store.url.encode(), manifest))
    folder = mirror_root().joinpath(*digests)
    _check_private(folder)
    if not (folder / name).is_file():
        write_whole(folder / name, manifest)
    return folder


def note_files(folder: Path, store: Store, files: Mapping[str, str]) -> None:
    """Write down which files, names with their SHA-256, can be fetched into a mirror: any process
    of this machine then finds it."""
    content = json.dumps(Mirror(store.url, files)._asdict()).encode()
    if not (note := _note_of(folder)).is_file() or note.read_bytes() != content:
        write_whole(note, content)
    _read_note.cache_clear()


def mirror_of(folder: Path) -> Mirror | None:
    """What a folder is a mirror of; None for any other folder, whatever lies beside it: a
    stranger's decides nothing about the network."""
    if folder.absolute().parent.parent != mirror_root():
        return None
    try:
        return _read_note(folder.absolute())
    except (OSError, ValueError, TypeError):
        return None


def fetch(path: Path) -> None:
    """Fetch a file into its mirror, unless it is there; any other path is left alone.

    Raises:
        StoreError: The store does not give it, or other bytes than the manifest lists.
        BrokenError: The store has no such file.
    """
    try:
        store_digest, digest, *names = path.absolute().relative_to(mirror_root()).parts
    except ValueError:
        return
    mirror, name = mirror_of(mirror_root() / store_digest / digest), "/".join(names)
    if mirror is None or name not in mirror.files:
        return
    if not path.is_file():
        with _lock(path):
            if not path.is_file():  # another process may have fetched it
                _download(mirror, name, path)
    with suppress(OSError):
        os.utime(path)  # files used longest ago make room first


def _download(mirror: Mirror, name: str, path: Path) -> None:
    with whole(path) as draft:
        try:
            Store(mirror.url).fetch(name, draft)
        except FileNotFoundError:
            raise BrokenError(
                f"{mirror.url}/{name}: is missing at the store, though it is listed"
            ) from None
        with open(draft, "rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != mirror.files[name]:
                raise StoreError(
                    f"{mirror.url}/{name}: is not the file that the manifest lists; if a run goes "
                    "on there, wait for its end and give the same command again; else generate "
                    "the dataset again"
                )
    _make_room(path)


def fetch_all(folder: Path, names: Collection[str]) -> None:
    """Fetch all of these into a mirror. Raises as `fetch`, and StoreError if there is no room for
    all of them."""
    from concurrent.futures import ThreadPoolExecutor  # importing it takes time

    with ThreadPoolExecutor(AT_A_TIME) as pool:
        list(pool.map(fetch, [folder / name for name in names]))
    if lost := [name for name in names if not (folder / name).exists()]:
        raise StoreError(
            f"{folder / lost[0]}: made room for others, though all are needed; raise {ROOM}"
        )


def bytes_in(folder: Path) -> int:
    """The bytes of a dataset's files; of a mirror, those of all files that it is of, fetched or
    not. Raises StoreError."""
    paths = (path for path in (*folder.glob("*"), *folder.glob("*-*x/*")) if path.is_file())
    sizes = {str(path.relative_to(folder)): path.stat().st_size for path in paths}
    if (mirror := mirror_of(folder)) is not None:
        objects = Store(mirror.url).list()
        sizes |= {name: objects[name] for name in mirror.files if name in objects}
    return sum(sizes.values())


def _note_of(folder: Path) -> Path:
    return Path(f"{folder}.place")


@lru_cache(maxsize=8)
def _read_note(folder: Path) -> Mirror:
    _check_private(folder)
    return Mirror(**json.loads(_note_of(folder).read_bytes()))


def _check_private(folder: Path) -> None:
    """Make a folder for mirrors. Raises StoreError if others may write to it."""
    if trouble := folder_trouble(folder):
        raise StoreError(
            f"{trouble}: copies of datasets go there; see to it, or name another folder by "
            "SCENEGEN_CACHE"
        )


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Have no other process fetch `path`. It saves requests, and nothing depends on it: a file
    system without locks, or a lock removed while another process waits, costs a second copy."""
    lock = Path(f"{path}.lock")
    with disk_told(path):
        path.parent.mkdir(exist_ok=True)
        file = open(lock, "wb")  # noqa: SIM115 (closed below; refusals of the disk are told)
    with file:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def _make_room(newest: Path) -> None:
    """Delete the shards used longest ago until all mirrors take no more than they may."""
    files = []
    for pattern in ("*/*/*", "*/*/*-*x/*"):
        for path in mirror_root().glob(pattern):
            with suppress(OSError):
                if path.suffix in (".h5", ".zip") and path != newest:
                    status = path.stat()
                    files.append((status.st_mtime_ns, status.st_size, path))
    total = sum(size for _, size, _ in files) + newest.stat().st_size
    max_bytes = _max_bytes(total)
    for _, size, path in sorted(files):
        if total <= max_bytes:
            return
        path.unlink(missing_ok=True)
        total -= size


def _max_bytes(total: int) -> int:
    """What mirrors may take, where they take `total`. Raises StoreError."""
    if text := os.environ.get(ROOM):
        with suppress(ValueError, OverflowError):
            if (max_bytes := int(float(text) * 1e9)) > 0:
                return max_bytes
        raise StoreError(f"{ROOM}={printable(text)}: expected gigabytes, such as 50")
    return (shutil.disk_usage(mirror_root()).free + total) // 2
