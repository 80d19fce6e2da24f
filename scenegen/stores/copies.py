"""A copy of a store's object with holes, which are filled when they are read: by blocks, once for
all processes.

Until it is whole, a copy is called ``.part``: the object, with holes; a checksum of each block, 0
for one that is not there; and which object it is of. Then it is held against the digest that the
manifest has of it, and takes its name. The copies used longest ago make room for others.
"""

import fcntl
import hashlib
import io
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import isal.isal_zlib

from lidarsim.jit import cache_root
from scenegen.errors import StoreError, printable
from scenegen.stores import Object, Part, home_of, store_of

BLOCK_BYTES = 1 << 16
LEAST_BLOCKS = 2
"""Blocks that are fetched at once."""
MOST_BYTES = 1 << 26
"""What is fetched at once at most."""
PART = ".part"
ROOM = "SCENEGEN_CACHE_GB"
"""What the environment calls the gigabytes that copies may take. By default they take at most half
of what the disk has for them."""
KEPT = (".json", ".npy")
"""Endings of what is small, and never makes room."""


class Note(NamedTuple):
    """What a folder of copies is of."""

    store: str
    files: Mapping[str, str]
    """Every file that the manifest lists, with its SHA-256."""


class Copy:
    """A copy with holes, opened: what is read of it is fetched, if it is not there.

    A run of blocks is fetched at once: twice as many as are there just before it, or a quarter of
    all that are there. So a few samples take a few blocks, and all of them a few requests. Any
    number of threads may read from it.
    """

    def __init__(self, path: Path, about: Note, handle: int, tail_bytes: int):
        self.path, self._about, self._handle = path, about, handle
        self._name = str(path.relative_to(home_of(path.parent)))
        self._sound: set[int] = set()
        self.bytes, self._version = _read_end(handle) or self._begin(tail_bytes)
        """The object's size, and a digest of its version."""
        self._blocks = _blocks_of(self.bytes)
        self._handle = os.dup(handle)  # which lasts longer

    @property
    def whole(self) -> bool:
        """Whether nothing lacks."""
        return self._lacking(range(self._blocks)) is None

    def pread(self, size: int, begin: int) -> bytes:
        """What `os.pread` gives of the object. Raises StoreError."""
        stop = min(begin + size, self.bytes)
        self._have(range(begin // BLOCK_BYTES, -(-stop // BLOCK_BYTES)))
        return os.pread(self._handle, max(stop - begin, 0), begin)

    def fileno(self) -> int:
        """A handle of the object as a file, which is fetched whole. Raises StoreError."""
        self._have(range(self._blocks))
        return self._handle

    def close(self) -> None:
        """Close the file."""
        os.close(self._handle)

    def _begin(self, tail_bytes: int) -> tuple[int, bytes]:
        """Make the file, with the object's tail in it; what stands at its end."""
        tail, found = self._fetch(Part(-tail_bytes))
        self.bytes, end = found.bytes, found.bytes + 4 * _blocks_of(found.bytes)
        os.ftruncate(self._handle, 0)
        os.ftruncate(self._handle, end)
        os.pwrite(self._handle, _digest(found) + found.bytes.to_bytes(8, "little"), end)
        first = _blocks_of(found.bytes - len(tail))
        self._put(first, tail[first * BLOCK_BYTES - (found.bytes - len(tail)) :])
        return found.bytes, _digest(found)

    def _have(self, blocks: range) -> None:
        """Have these blocks be there; the file takes its name once nothing lacks."""
        every = range(self._blocks)
        if blocks != every and self._lacking(blocks) is None:
            return
        # opened anew: threads that share a handle, and forks, would share its lock
        with open(f"/dev/fd/{self._handle}", "rb") as file:
            lock(file.fileno())
            while (first := self._lacking(blocks)) is not None:
                self._fetch_run(first, blocks.stop)
            if self.whole and os.fstat(self._handle).st_size != self.bytes:
                self._finish()

    def _finish(self) -> None:
        """Give the file its name, if it is what the manifest lists: until then, checksums stand at
        its end, and who reads on is told again. Raises StoreError."""
        digest = hashlib.sha256()
        for begin in range(0, self.bytes, MOST_BYTES):
            digest.update(os.pread(self._handle, min(MOST_BYTES, self.bytes - begin), begin))
        if digest.hexdigest() != self._about.files[self._name]:
            raise self._not_listed()
        with disk_told(self._about.store):
            os.ftruncate(self._handle, self.bytes)
            os.fsync(self._handle)
            stamp(self._handle)
            if is_at(self._handle, part := part_of(self.path)):
                part.replace(self.path)

    def _not_listed(self) -> StoreError:
        """What is there is of no use, and goes."""
        part_of(self.path).unlink(missing_ok=True)
        return StoreError(
            f"{self._about.store}/{self._name}: is not the file that the manifest lists; if a "
            "run goes on there, wait for its end and give the same command again; else generate "
            "the dataset again"
        )

    def _lacking(self, blocks: range) -> int | None:
        """The first of these blocks that is not there; None where all are."""
        for n in blocks:
            if n not in self._sound:
                sums = os.pread(self._handle, 4, self.bytes + 4 * n)
                if sums and sums != _checksum(self._read(n)):  # none are left of a whole copy
                    return n
                self._sound.add(n)
        return None

    def _read(self, block: int) -> bytes:
        begin = block * BLOCK_BYTES
        return os.pread(self._handle, min(BLOCK_BYTES, self.bytes - begin), begin)

    def _fetch_run(self, first: int, stop: int) -> None:
        """Fetch blocks from `first` on, until `stop` or further, or until one that is there."""
        sums = memoryview(os.pread(self._handle, 4 * self._blocks, self.bytes)).cast("I").tolist()
        behind = first
        while behind and sums[behind - 1]:
            behind -= 1
        there = self._blocks - sums.count(0)
        run = max(stop - first, LEAST_BLOCKS, 2 * (first - behind), there // 4)
        most = min(first + min(run, MOST_BYTES // BLOCK_BYTES), self._blocks)
        last = next((n for n in range(first + 1, most) if sums[n]), most)
        begin, end = first * BLOCK_BYTES, min(last * BLOCK_BYTES, self.bytes)
        content, found = self._fetch(Part(begin, end))
        expected = self._version, self.bytes, end - begin
        if (_digest(found), found.bytes, len(content)) != expected:
            raise self._not_listed()
        self._put(first, content)

    def _fetch(self, part: Part) -> tuple[bytes, Object]:
        file = io.BytesIO()
        with disk_told(self._about.store):
            found = store_of(self._about.store).read(self._name, file, 1 << 62, part)
        make_room(file.tell())
        return file.getvalue(), found

    def _put(self, first: int, content: bytes) -> None:
        """Put what was fetched from block `first` on into the file, before the checksums that tell
        of it."""
        sums = b"".join(
            _checksum(content[begin : begin + BLOCK_BYTES])
            for begin in range(0, len(content), BLOCK_BYTES)
        )
        with disk_told(self._about.store):
            os.pwrite(self._handle, content, first * BLOCK_BYTES)
            os.pwrite(self._handle, sums, self.bytes + 4 * first)


def _checksum(content: bytes) -> bytes:
    return (isal.isal_zlib.crc32(content) or 1).to_bytes(4, "little")


def _digest(found: Object) -> bytes:
    return hashlib.sha256(str(found.version).encode()).digest()


def _blocks_of(size: int) -> int:
    return -(-size // BLOCK_BYTES)


def _read_end(handle: int) -> tuple[int, bytes] | None:
    """The size of the object that a file is a copy of with holes, and a digest of its version; None
    where it is none, as what a killed process leaves."""
    size = os.fstat(handle).st_size
    end = os.pread(handle, 40, max(size - 40, 0))
    whole = int.from_bytes(end[32:], "little")
    return (whole, end[:32]) if size and size == whole + 4 * _blocks_of(whole) + 40 else None


def part_of(path: Path) -> Path:
    """Where a copy lies until it is whole."""
    return path.with_name(path.name + PART)


def lock(handle: int, how: int = fcntl.LOCK_EX) -> bool:
    """Lock a file, or say that another process has; where locks cannot be had, go on without: then
    two may fetch the same."""
    try:
        fcntl.flock(handle, how)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


@contextmanager
def alone(path: Path, store: str) -> Iterator[int]:
    """The file that becomes `path` once it is whole, which nobody else has locked meanwhile."""
    part, flags = part_of(path), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    while True:
        with disk_told(store):
            handle = os.open(part, flags, 0o600)
        try:
            lock(handle)
            if not is_at(handle, part):
                continue  # who had it has finished it, or removed it
            yield handle
            return
        finally:
            if not os.fstat(handle).st_size and is_at(handle, part):
                part.unlink()
            lock(handle, fcntl.LOCK_UN)  # which else would last as long as a copy's handle
            os.close(handle)


def is_at(handle: int, path: Path) -> bool:
    """Whether an open file is the one at `path`."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(handle), path.lstat())
    return False


def stamp(handle: int) -> None:
    """Note that a file is the one listed: its time of change becomes its size, in nanoseconds,
    until it changes."""
    with suppress(OSError):  # a root's copy, that this user may only read
        os.utime(handle, ns=(time.time_ns(), os.fstat(handle).st_size))


@contextmanager
def disk_told(store: str) -> Iterator[None]:
    """A disk's refusal comes out as StoreError."""
    try:
        yield
    except FileNotFoundError:
        raise  # the store's: it has no such object
    except OSError as error:
        raise StoreError(
            f"{printable(error)}: copies of {store} go there; free some space, or name another "
            "folder by SCENEGEN_CACHE"
        ) from None


_left = 0
"""Bytes that this process may fetch before it looks whether there is room."""


def make_room(asked: int) -> None:
    """Before so many bytes are kept, delete the copies used longest ago, but for those that
    somebody is fetching, until all take no more than they may. A process looks after each 64th of
    that."""
    global _left
    _left -= asked
    if _left >= 0:
        return
    files = []
    for path in (*root().glob("*/*/*"), *root().glob("*/*/*-*x/*")):
        with suppress(FileNotFoundError):
            found = path.stat()
            used = max(found.st_atime_ns, found.st_mtime_ns)
            if path.suffix not in KEPT and not path.is_dir():
                files.append((used, 512 * found.st_blocks, path))
    total = sum(size for _, size, _ in files)
    most = _most_bytes(total)
    _left = most // 64
    for _, size, path in sorted(files):
        if total + asked + _left <= most:
            break
        with suppress(OSError), open(path, "rb") as file:
            if lock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB):
                path.unlink()
                total -= size


def _most_bytes(total: int) -> int:
    """What copies may take, where they take `total`. Raises StoreError."""
    if said := os.environ.get(ROOM):
        with suppress(ValueError, OverflowError):
            if (most := int(float(said) * 1e9)) > 0:
                return most
        raise StoreError(f"{ROOM}={printable(said)}: expected gigabytes, such as 50")
    return (shutil.disk_usage(root()).free + total) // 2


def root() -> Path:
    """Where copies lie, each in a folder of a folder."""
    return cache_root() / "scenegen" / "places"
