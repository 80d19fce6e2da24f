"""Completions of a whole split of a dataset, in one file."""

import io
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np

from scenegen.dataset.read import Dataset, Rows, Split
from scenegen.dataset.shard import compress
from scenegen.errors import DatasetError, empty_split
from scenegen.files import check_ours, whole
from scenegen.model.calibration import RISK
from scenegen.model.completion.completer import Completer, opened_once
from scenegen.model.completion.protocol import PARTS, SURE
from scenegen.model.inputs import channels
from scenegen.run import Executor, check_together

PACKED = {"compression": "gzip", "compression_opts": 1}
"""How HDF5 reads what `compress` made. HDF5 itself compresses nothing here: where a disk refuses
its chunks, it crashes."""
PART = 40
"""Samples of a part, about, where an executor has a split completed."""
Chunks: TypeAlias = dict[str, list[bytes]]
"""Maps by the name of what they tell, each compressed as HDF5 has it, in the order of `PARTS` and
`SURE`."""
Part: TypeAlias = tuple[Rows, Chunks, list[float]]
"""Maps of some rows, and how far from home each is."""


def predict_split(
    completer: Completer,
    folder: Path,
    split: str,
    out: Path,
    *,
    batch: int = 8,
    execute: Executor | None = None,
    on_start: Callable[[int], None] = lambda total: None,
    on_done: Callable[[int], None] = lambda samples: None,
) -> list[float]:
    """Complete every sample of a split and write what docs/bench.md calls a predictions file to
    `out`, whole or not. Returns how far from home each is, see `Prediction.away`; [] where nobody
    knows.

    This process does it, `batch` maps at once; or `execute` has it done, on one thread a process.
    Raises DatasetError for another grid, an empty split, a disk that refuses, where `out` is
    something else already, and where `execute` leaves samples to others.
    """
    check_ours(out)
    dataset = Dataset(folder, whole=True)
    if dataset.grid != completer.grid:
        raise DatasetError(
            f"{folder}: its maps are on {dataset.grid}, {completer.name} completes maps on "
            f"{completer.grid}; train a "
            "network on this grid with `scenegen train`"
        )
    samples = dataset.split(split)
    if not len(samples):
        raise DatasetError(f"{folder}: {empty_split(split)}, or give another --split")
    each = batch if execute is None else batch * math.ceil(PART / batch)
    tasks = [
        Rows(split, range(first, min(first + each, len(samples))))
        for first in range(0, len(samples), each)
    ]
    begin = partial(on_start, len(samples))
    if execute is None:
        begin()
        results: Any = (_completed(completer, samples, batch, rows) for rows in tasks)
    else:
        check_together(execute, "a file of predictions holds")
        results = execute(partial(_elsewhere, completer.opened, samples, batch), tasks, begin)
    away: list[float] = []
    with closing(results):
        _write(out, samples, completer, _in_order(results, on_done, away))
    return away


def _completed(completer: Completer, samples: Split, batch: int, rows: Rows) -> Part:
    """The maps of `rows`, completed `batch` at once."""
    found: Chunks = {}
    away: list[float] = []
    grid = samples.dataset.grid
    for first in range(0, len(rows.numbers), batch):
        several = [samples[number] for number in rows.numbers[first : first + batch]]
        read = [channels(completer.inputs, one, grid, one.lidar) for one in several]
        said = completer({name: np.stack([one[name] for one in read]) for name in completer.inputs})
        for name in PARTS | SURE:
            if (maps := getattr(said, name)) is not None:
                found.setdefault(name, []).extend(compress(values) for values in maps)
        far = said.away(np.stack([one.observed for one in several]))
        away += [] if far is None else far.tolist()
    return rows, found, away


def _elsewhere(opened: Any, samples: Split, batch: int, rows: Rows) -> Part:
    return _completed(opened_once(*opened), samples, batch, rows)


def _in_order(
    results: Iterable[Part], on_done: Callable[[int], None], away: list[float]
) -> Iterator[Chunks]:
    """What `_completed` gives, as it comes, in the order of samples; `away` grows with it."""
    waiting: dict[int, Part] = {}
    following = 0
    for part in results:
        waiting[part[0].numbers[0]] = part
        on_done(len(part[0].numbers))
        while following in waiting:
            rows, chunks, far = waiting.pop(following)
            away += far
            yield chunks
            following += len(rows.numbers)


def _write(out: Path, samples: Split, completer: Completer, parts: Iterable[Chunks]) -> None:
    """Write a predictions file to `out`, whole or not: a split's `parts`, in order, so that the
    file has the same bytes however they are parted."""
    dataset, names, row = samples.dataset, samples.names, 0
    about = {"dataset": dataset.manifest.digest, "split": samples.name, "method": completer.name}
    shape = dataset.grid.shape
    with new_hdf5(out) as file:
        file.attrs.update(about | ({} if completer.calibration is None else {"risk": RISK}))
        file["world"] = np.array([world for _, world, _ in names], dtype=np.int64)
        file["viewpoint"] = np.array([viewpoint for _, _, viewpoint in names], dtype=np.int64)
        for part in parts:
            for name in part:
                if name not in file:
                    full, chunk = (len(names), *shape), (1, *shape)
                    file.create_dataset(name, full, np.float32, chunks=chunk, **PACKED)
            for chunks in zip(*part.values(), strict=True):
                for name, chunk in zip(part, chunks, strict=True):
                    file[name].id.write_direct_chunk((row, 0, 0, 0), chunk)
                row += 1


class _Disk(io.FileIO):
    """What HDF5 writes to. A disk that refuses ends the writing at once; all that HDF5 must still
    write to close the file, and would fail at again and again, then goes nowhere."""

    refused = False

    def write(self, content: Any) -> int:
        """All of `content`. Raises the first OSError, and no other."""
        left = memoryview(content)
        try:
            while left.nbytes and not self.refused:
                left = left[super().write(left) :]
        except OSError:
            self.refused = True
            raise
        return memoryview(content).nbytes

    def truncate(self, size: int | None = None) -> int:
        """The same."""
        return 0 if self.refused else super().truncate(size)


@contextmanager
def new_hdf5(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file to fill, which then stands at `path`, whole or not. Raises as `whole`."""
    with whole(path) as draft, _Disk(draft, "r+") as disk, h5py.File(disk, "w") as file:
        yield file
