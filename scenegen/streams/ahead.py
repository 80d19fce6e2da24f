"""Units of a stream made before they are asked for: by worker processes, packed small, and kept in
a folder."""

import contextlib
import hashlib
import math
import multiprocessing.connection
import os
import struct
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import isal.isal_zlib
import numpy as np

from scenegen.errors import DatasetError, GenerationError, raised_as
from scenegen.files import make_way, read_bounded, write_whole
from scenegen.run.workers import MOST_REPLACED, Worker
from scenegen.sample import FIELDS, Sample, Schema
from scenegen.truth import distance_field

Unit = tuple[bytes, ...]
"""The records of a unit's samples."""
Slot = tuple[int, int]
"""Which unit: the number of its component in a mixture, and its own there."""
LEVEL = 1
"""The level of compression, as in shards."""


def record_type(schema: Schema) -> np.dtype:
    """The record of one sample: flags as bits, everything else as it is stored on disk. Distances
    follow from occupancy, and are ten times as large as all the rest: they are not in it."""
    columns: list[tuple[Any, ...]] = []
    for name in schema.names:
        if name == "tudf":
            continue
        shape = schema.shape(name)
        if _is_flags(name):
            columns.append((name, "u1", -(-math.prod(shape) // 8)))
        else:
            columns.append((name, FIELDS[name]["dtype"], shape))
    return np.dtype(columns)


def _is_flags(name: str) -> bool:
    """Whether a field's values are true or false, which a record holds as bits."""
    return bool(FIELDS[name]["dtype"] == "bool")


def pack(sample: Sample, kind: np.dtype) -> bytes:
    """A sample's record, compressed."""
    record = np.zeros((), kind)
    for name in kind.names or ():
        value = getattr(sample, name)
        record[name] = np.packbits(value) if _is_flags(name) else value
    return isal.isal_zlib.compress(record.tobytes(), LEVEL)


def unpack(packed: bytes, kind: np.dtype, schema: Schema) -> Sample:
    """The sample of a record; arrays of its own, which may be written to. Raises ValueError for
    bytes that are none."""
    with raised_as(ValueError, "cannot be unpacked: ", of=isal.isal_zlib.error):
        content = isal.isal_zlib.decompressobj().decompress(packed, kind.itemsize + 1)
    if len(content) != kind.itemsize:
        raise ValueError(f"{len(content)} bytes, expected {kind.itemsize}")
    record = np.frombuffer(content, kind)[0]

    def find(sample: Sample, name: str) -> Any:
        if name == "tudf":
            return distance_field(sample.occupancy, schema.grid)
        value: np.ndarray = record[name]
        if _is_flags(name):
            shape = schema.shape(name)
            return np.unpackbits(value, count=math.prod(shape)).view(bool).reshape(shape)
        return value.item() if FIELDS[name]["axes"] == "" else value.copy()

    return Sample.lazy(schema.names, find, lidar=schema.lidar, grid=schema.grid)


HEAD = b"scenegen unit 2\n"
"""The number is raised whenever records change. Units of 1 held labels as bits."""
IN_FOLDER = 1000
"""Units in a folder."""
MOST_UNIT_BYTES = 1 << 30
"""A larger file is no unit's: of default maps, one has a few hundred kilobytes."""


@dataclass(frozen=True)
class Cache:
    """The units of one component.

    A file holds `HEAD`, a SHA-256 of what follows and of whose unit it is, and the records, each
    after its length. So a file that is cut off, changed, or another unit's under this name counts
    as absent. Raises DatasetError for a folder that is a file.
    """

    folder: Path
    owner: str
    """A digest of all that the units depend on, versions of software included."""
    split: str

    def __post_init__(self) -> None:
        if self.folder.exists() and not self.folder.is_dir():
            raise DatasetError(
                f"{self.folder}: is a file, expected a folder for the cache; choose another one"
            )

    def unit(self, number: int, make: Callable[[], Unit]) -> Unit:
        """The records of a unit: those on disk, else what `make` gives, which then is on disk.

        Raises DatasetError where the disk refuses, and what `make` raises.
        """
        path = self.path(number)
        # of what is too large, or no file at all, writing says what to do
        with contextlib.suppress(FileNotFoundError, ValueError, DatasetError):
            return self._parse(read_bounded(path, MOST_UNIT_BYTES), number)
        records = make()
        make_way(path)
        body = b"".join(struct.pack("<I", len(record)) + record for record in records)
        write_whole(path, HEAD + self._sum(body, number) + body)
        return records

    def path(self, number: int) -> Path:
        """Where a unit lies."""
        group, rest = divmod(number, IN_FOLDER)
        return self.folder / self.owner[:16] / f"{self.split}-{group:07d}" / f"{rest:03d}.unit"

    def _parse(self, content: bytes, number: int) -> Unit:
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


class Ahead:
    """`workers` processes that make units in the order in which they are given. They end with this
    object, and with this process whatever ends it; one that dies is replaced, and its units are
    given again."""

    def __init__(self, make: Callable[[Slot], Unit], workers: int):
        self._make, self._died = make, 0
        self._given = {Worker(make): deque[Slot]() for _ in range(workers)}
        self._done: dict[Slot, tuple[bool, Any]] = {}
        # unlike a `__del__`, it runs at exit before the modules that it needs are gone
        self.close = weakref.finalize(self, _end, self._given, os.getpid())
        """End the processes, whatever they are doing."""

    @property
    def under_way(self) -> int:
        """Units that were given, and that nobody took."""
        return len(self._done) + sum(map(len, self._given.values()))

    def __contains__(self, slot: object) -> bool:
        return slot in self._done or any(slot in given for given in self._given.values())

    def give(self, slot: Slot) -> None:
        """Have a unit made; one that is under way is not given again."""
        if slot not in self:
            worker, given = min(self._given.items(), key=lambda one: len(one[1]))
            given.append(slot)
            with contextlib.suppress(OSError):  # it died, which `collect` notices
                worker.pipe.send(slot)

    def take(self, slot: Slot) -> Unit:
        """A unit, as soon as it is there. Raises what making it raises, and GenerationError where
        processes die again and again."""
        self.give(slot)
        self.collect()
        while slot not in self._done:
            self.collect(wait=True)
        succeeded, value = self._done.pop(slot)
        if not succeeded:
            raise value
        return value

    def collect(self, *, wait: bool = False) -> None:
        """Take in what is finished, or, with `wait`, at least one thing."""
        workers = {worker.pipe: worker for worker in self._given}
        for pipe in multiprocessing.connection.wait(workers, None if wait else 0):
            worker = workers[pipe]
            try:
                answer = worker.pipe.recv()
            except (EOFError, OSError):
                self._replace(worker)
                continue
            self._done[self._given[worker].popleft()] = answer

    def _replace(self, worker: Worker) -> None:
        """Another process in the place of one that died."""
        self._died += 1
        if self._died > MOST_REPLACED:
            raise GenerationError(
                f"stream: worker processes were killed {self._died} times (out of memory?); give "
                f"fewer than {len(self._given)}"
            )
        worker.end()
        given, another = self._given.pop(worker), Worker(self._make)
        self._given[another] = given
        for slot in given:
            another.pipe.send(slot)


def _end(workers: dict[Worker, deque[Slot]], process: int) -> None:
    if process == os.getpid():  # not in a fork, whose parent's they are
        for worker in workers:
            worker.end()
    workers.clear()
