"""Mirrors: local folders that hold files of a store's dataset.

A mirror belongs to one store and one manifest; a note beside it records both. A file is fetched
completely when it is first opened, and checked against the manifest's SHA-256. Afterwards it is an
ordinary file. A mirror is used only if nobody but this user may write to it.
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
from scenegen.base.errors import CorruptFileError, StoreError, printable
from scenegen.base.files import disk_errors, whole, write_atomic
from scenegen.base.stores import Store

AT_A_TIME = 8
"""Number of concurrent downloads."""
ROOM = "SCENEGEN_CACHE_GB"
"""Environment variable for the gigabytes that all mirrors may take. By default: half of the disk
space that is free or already used by mirrors."""


class Mirror(NamedTuple):
    """The origin of a mirror."""

    url: str
    files: Mapping[str, str]
    """SHA-256 of every file that the manifest lists, by name."""


def mirror_root() -> Path:
    """Folder of all mirrors. Each is two levels below, by the digests of its store and manifest."""
    return cache_root() / "scenegen" / "places"


def make_mirror(store: Store, name: str, manifest: bytes) -> Path:
    """Make a mirror, and write the manifest into it.

    Args:
        store: The store.
        name: Name of the manifest.
        manifest: Its content.

    Returns:
        The mirror's folder.

    Raises:
        StoreError: if other users may write to the folder.
    """
    digests = (hashlib.sha256(text).hexdigest()[:16] for text in (store.url.encode(), manifest))
    folder = mirror_root().joinpath(*digests)
    _check_private(folder)
    # the folder has the manifest's digest in its name, so a manifest that is there is this one
    if not (folder / name).is_file():
        write_atomic(folder / name, manifest)
    return folder


def note_files(folder: Path, store: Store, files: Mapping[str, str]) -> None:
    """Record which files a mirror can fetch. Every process of this machine reads the note.

    Args:
        folder: The mirror.
        store: Its store.
        files: SHA-256 of each file, by name.
    """
    content = json.dumps(Mirror(store.url, files)._asdict()).encode()
    # written only when it changes, as many processes open the same mirror
    if not (note := _note_of(folder)).is_file() or note.read_bytes() != content:
        write_atomic(note, content)
    # this process may have read the note before it changed
    _read_note.cache_clear()


def mirror_of(folder: Path) -> Mirror | None:
    """The origin of a mirror; None for a folder that is not below `mirror_root`."""
    # a note beside any other folder is ignored: an untrusted file must not cause network requests
    if folder.absolute().parent.parent != mirror_root():
        return None
    try:
        return _read_note(folder.absolute())
    except (OSError, ValueError, TypeError):
        return None


def fetch(path: Path) -> None:
    """Fetch a file of a mirror unless it is there. Other paths are ignored.

    Args:
        path: The file.

    Raises:
        StoreError: if the store fails, or its file does not match the manifest.
        CorruptFileError: if the store has no such file.
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
        os.utime(path)  # `_make_room` deletes the least recently used files first


def _download(mirror: Mirror, name: str, path: Path) -> None:
    with whole(path) as draft:
        try:
            Store(mirror.url).fetch(name, draft)
        except FileNotFoundError:
            raise CorruptFileError(
                f"{mirror.url}/{name}: is missing at the store, though it is listed"
            ) from None
        # checked before the file gets its name: `fetch` trusts every file that has one
        with open(draft, "rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != mirror.files[name]:
                raise StoreError(
                    f"{mirror.url}/{name}: is not the file that the manifest lists; if a run goes "
                    "on there, wait for its end and give the same command again; else generate "
                    "the dataset again"
                )
    _make_room(path)


def fetch_all(folder: Path, names: Collection[str]) -> None:
    """Fetch several files of a mirror.

    Args:
        folder: The mirror.
        names: Names of the files.

    Raises:
        StoreError: as `fetch`, or if they do not fit into the mirror together.
        CorruptFileError: as `fetch`.
    """
    from concurrent.futures import ThreadPoolExecutor  # importing it takes time

    with ThreadPoolExecutor(AT_A_TIME) as pool:
        # a list: an error in a thread is raised only when its result is taken
        list(pool.map(fetch, [folder / name for name in names]))
    # a later download may have evicted an earlier one
    if lost := [name for name in names if not (folder / name).exists()]:
        raise StoreError(
            f"{folder / lost[0]}: made room for others, though all are needed; raise {ROOM}"
        )


def bytes_in(folder: Path) -> int:
    """Total size of a dataset's files, bytes. Of a mirror, files that are not fetched yet count as
    well.

    Raises:
        StoreError: if the store of a mirror cannot be listed.
    """
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
    """Make a folder for mirrors. Raises StoreError if other users may write to it."""
    if trouble := folder_trouble(folder):
        raise StoreError(
            f"{trouble}: copies of datasets go there; see to it, or name another folder by "
            "SCENEGEN_CACHE"
        )


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Keep other processes from fetching the same file.

    The lock only saves requests. On a file system without locks, or if a lock is removed while
    another process waits, the file is fetched twice.
    """
    lock = Path(f"{path}.lock")
    with disk_errors(path):
        # shards beyond the first thousand lie in a subfolder
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
    """Delete the least recently used shards until all mirrors fit into `_max_bytes`."""
    files = []
    for pattern in ("*/*/*", "*/*/*-*x/*"):
        for path in mirror_root().glob(pattern):
            with suppress(OSError):
                # manifests and tables of rays are small, and every opening needs them
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
    """Space that mirrors may take, bytes; `total` is what they take now. Raises StoreError for a
    malformed `ROOM`."""
    if text := os.environ.get(ROOM):
        with suppress(ValueError, OverflowError):
            if (max_bytes := int(float(text) * 1e9)) > 0:
                return max_bytes
        raise StoreError(f"{ROOM}={printable(text)}: expected gigabytes, such as 50")
    return (shutil.disk_usage(mirror_root()).free + total) // 2
