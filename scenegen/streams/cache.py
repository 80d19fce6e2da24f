"""Units of a stream on disk: a file each, written whole, checked when it is read, and made again if
it is damaged."""

import functools
import hashlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from scenegen.errors import DatasetError
from scenegen.files import make_parent, read_bounded, remove_drafts, write_whole

HEAD = b"scenegen unit 1\n"
IN_FOLDER = 1000
"""Units in a folder."""


@dataclass(frozen=True)
class Cache:
    """The units of one component.

    A file holds `HEAD`, a SHA-256 of what follows and of whose unit it is, and the records, each
    after its length. So a file that is cut off, changed, or another unit's under this name counts
    as absent.
    """

    folder: Path
    owner: str
    """A digest of all that the units depend on, versions of software included."""
    split: str
    most_bytes: int
    """A unit's file is no larger."""

    def unit(self, number: int, make: Callable[[], tuple[bytes, ...]]) -> tuple[bytes, ...]:
        """The records of a unit: those on disk, else what `make` gives, which then is on disk.

        Raises DatasetError where the disk refuses, and what `make` raises.
        """
        path = self.path(number)
        try:
            return self._parse(read_bounded(path, self.most_bytes), number)
        except (FileNotFoundError, ValueError):
            pass
        except (
            DatasetError
        ):  # too large, or no file at all: what writing says of it tells what to do
            pass
        records = make()
        make_parent(path)
        _tidy(path.parent)
        body = b"".join(struct.pack("<I", len(record)) + record for record in records)
        write_whole(path, HEAD + self._sum(body, number) + body)
        return records

    def path(self, number: int) -> Path:
        """Where a unit lies."""
        group, rest = divmod(number, IN_FOLDER)
        return self.folder / self.owner[:16] / f"{self.split}-{group:07d}" / f"{rest:03d}.unit"

    def _parse(self, content: bytes, number: int) -> tuple[bytes, ...]:
        """The records in a file. Raises ValueError for one that is not as it was written."""
        start = len(HEAD) + hashlib.sha256().digest_size
        body = content[start:]
        if content[:start] != HEAD + self._sum(body, number):
            raise ValueError("damaged")
        records, at = [], 0
        while at < len(body):
            (length,) = struct.unpack_from("<I", body, at)
            records.append(body[at + 4 : at + 4 + length])
            at += 4 + length
        return tuple(records)

    def _sum(self, body: bytes, number: int) -> bytes:
        return hashlib.sha256(f"{self.owner} {self.split} {number} ".encode() + body).digest()


@functools.lru_cache(maxsize=64)
def _tidy(folder: Path) -> None:
    """Delete, once a process, what writers that were killed left behind."""
    remove_drafts(folder)
