"""Units of a stream made before they are asked for: by worker processes, packed small, and kept in
a folder."""

import contextlib
import hashlib
import multiprocessing.connection
import os
import struct
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

import isal.isal_zlib
import numpy as np
from numpy.typing import NDArray

from scenegen.errors import DatasetError, GenerationError, raised_as
from scenegen.files import make_way, read_bounded, write_whole
from scenegen.run.workers import MOST_REPLACED, Result, Task, Worker
from scenegen.sample import FIELDS, Sample, Schema
from scenegen.truth import distance_field

LEVEL = 1
"""The level of compression, as in shards."""


def record_type(schema: Schema) -> np.dtype:
    """The record of one sample: grids as bits, everything else as it is stored on disk. Distances
    follow from occupancy, and are ten times as large as all the rest: they are not in it."""
    columns: list[tuple[Any, ...]] = []
    for name in schema.names:
        if name == "tudf":
            continue
        shape, about = schema.shape(name), FIELDS[name]
        if about["axes"] == "grid":
            columns.append((name, "u1", -(-int(np.prod(shape)) // 8)))
        else:
            columns.append((name, about["dtype"], shape))
    return np.dtype(columns)


def pack(sample: Sample, kind: np.dtype) -> bytes:
    """A sample's record, compressed."""
    record = np.zeros((), kind)
    for name in kind.names or ():
        value = getattr(sample, name)
        record[name] = np.packbits(value) if FIELDS[name]["axes"] == "grid" else value
    return isal.isal_zlib.compress(record.tobytes(), LEVEL)


def unpack(packed: bytes, kind: np.dtype, schema: Schema) -> Sample:
    """The sample of a record; arrays of its own, which may be written to. Raises ValueError for
    bytes that are none."""
    with raised_as(ValueError, "cannot be unpacked: ", of=isal.isal_zlib.error):
        content = isal.isal_zlib.decompressobj().decompress(packed, kind.itemsize + 1)
    if len(content) != kind.itemsize:
        raise ValueError(f"{len(content)} bytes, expected {kind.itemsize}")
    record, grid = np.frombuffer(content, kind)[0], schema.grid

    def find(sample: Sample, name: str) -> Any:
        if name == "tudf":
            return distance_field(sample.occupancy, grid)
        value: NDArray[Any] = record[name]
        if FIELDS[name]["axes"] == "grid":
            count = int(np.prod(grid.shape))
            return np.unpackbits(value, count=count).view(bool).reshape(grid.shape)
        return int(value) if FIELDS[name]["axes"] == "" else value.copy()

    return Sample.lazy(schema.names, find, lidar=schema.lidar, grid=grid)


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
        # of what is too large, or no file at all, writing says what to do
        with contextlib.suppress(FileNotFoundError, ValueError, DatasetError):
            return self._parse(read_bounded(path, self.most_bytes), number)
        records = make()
        make_way(path)
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


class Ahead(Generic[Task, Result]):
    """`workers` processes that work off tasks in the order in which they are given. They end with
    this object, and with this process whatever ends it; one that dies is replaced, and its tasks
    are given again."""

    def __init__(self, function: Callable[[Task], Result], workers: int):
        self._function, self._count, self._died = function, workers, 0
        self._workers = [Worker(function) for _ in range(workers)]
        self._given: list[deque[Task]] = [deque() for _ in range(workers)]
        self._done: dict[Task, tuple[bool, Any]] = {}
        # unlike a `__del__`, it runs at exit before the modules that it needs are gone
        self.close = weakref.finalize(self, _end, self._workers, os.getpid())
        """End the processes, whatever they are doing."""

    @property
    def under_way(self) -> int:
        """Tasks that were given, and whose results nobody took."""
        return len(self._done) + sum(map(len, self._given))

    def __contains__(self, task: object) -> bool:
        return task in self._done or any(task in given for given in self._given)

    def give(self, task: Task) -> None:
        """Have a result made; a task that is under way is not given again."""
        if task not in self:
            worker = min(range(self._count), key=lambda n: len(self._given[n]))
            self._given[worker].append(task)
            with contextlib.suppress(OSError):  # it died, which `collect` notices
                self._workers[worker].pipe.send(task)

    def take(self, task: Task) -> Result:
        """The result of a task, as soon as it is there. Raises what the function raises, and
        GenerationError where processes die again and again."""
        self.give(task)
        self.collect()
        while task not in self._done:
            self.collect(wait=True)
        succeeded, value = self._done.pop(task)
        if not succeeded:
            raise value
        return value

    def collect(self, *, wait: bool = False) -> None:
        """Take in what is finished, or, with `wait`, at least one thing."""
        pipes = {worker.pipe: n for n, worker in enumerate(self._workers)}
        for pipe in multiprocessing.connection.wait(list(pipes), None if wait else 0):
            number = pipes[pipe]
            try:
                answer = self._workers[number].pipe.recv()
            except (EOFError, OSError):
                self._replace(number)
                continue
            self._done[self._given[number].popleft()] = answer

    def _replace(self, number: int) -> None:
        """Another process in the place of one that died."""
        self._died += 1
        if self._died > MOST_REPLACED:
            raise GenerationError(
                f"stream: worker processes were killed {self._died} times (out of memory?); give "
                f"fewer than {self._count}"
            )
        self._workers[number].end()
        self._workers[number] = Worker(self._function)
        for task in self._given[number]:
            self._workers[number].pipe.send(task)


def _end(workers: list[Worker], process: int) -> None:
    if process == os.getpid():  # not in a fork, whose parent's they are
        for worker in workers:
            worker.end()
    workers.clear()
