"""Units of a stream made before they are asked for, by worker processes, and packed small."""

import contextlib
import math
import multiprocessing.connection
import os
import weakref
from collections import deque
from collections.abc import Callable
from typing import Any

import isal.isal_zlib
import numpy as np

from scenegen.errors import GenerationError
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
    """The sample of a record; arrays of its own, which may be written to."""
    record = np.frombuffer(isal.isal_zlib.decompress(packed), kind)[0]

    def find(sample: Sample, name: str) -> Any:
        if name == "tudf":
            return distance_field(sample.occupancy, schema.grid)
        value: np.ndarray = record[name]
        if _is_flags(name):
            shape = schema.shape(name)
            return np.unpackbits(value, count=math.prod(shape)).view(bool).reshape(shape)
        return value.item() if FIELDS[name]["axes"] == "" else value.copy()

    return Sample.lazy(schema.names, find, lidar=schema.lidar, grid=schema.grid)


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
