"""Completions of a whole split of a dataset, in a folder of files."""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from scenegen.dataset.read import AnyDataset, Split
from scenegen.dataset.schema import stem_of
from scenegen.dataset.shard import compress
from scenegen.errors import DatasetError, GuardError, empty_split, printable, raised_as
from scenegen.files import Json, claim, make_parent, open_bounded, whole
from scenegen.limits import GUARD_BYTES, GUARD_S
from scenegen.model.completion.completer import Completer, opened_once
from scenegen.model.completion.protocol import PARTS, STORED
from scenegen.model.config import PREDICTIONS
from scenegen.model.inputs import channels
from scenegen.run import Counted, Executor, chunked, counted, unheard
from scenegen.run.workers import ALONE, guarded

PACKED = {"compression": "gzip", "compression_opts": 1}
"""How HDF5 reads what `compress` made. HDF5 itself compresses nothing here: where a disk refuses
its chunks, it crashes."""
PART = 100
"""Samples in a file, which is the unit of work, of writing and of recovery, as a shard is."""


def predict_split(
    completer: Completer,
    dataset: AnyDataset,
    split: str,
    out: Path,
    *,
    execute: Executor | None = None,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
) -> list[float]:
    """Complete every sample of a split and write what docs/bench.md calls predictions to the folder
    `out`: files called as shards are, of `PART` samples each, whole or not. Those that are there
    are kept, so that a run goes on where another one ended. Returns how far from home each sample
    is that was completed now, see `Prediction.away`; [] where nobody knows.

    This process does it; or `execute` has it done, on one thread a process. `on_start` is called
    with the number of samples once the work has begun, `on_done` with how many more are written.
    Raises DatasetError for another grid, an empty split, a disk that refuses, and where `out` is
    something else already.
    """
    with raised_as(DatasetError, f"{dataset.name}: "):
        completer.check_grid(dataset.grid)
    samples = dataset.split(split)
    if not (count := len(samples)):
        raise DatasetError(f"{dataset.name}: {empty_split(split)}, or give another --split")
    about = {"dataset": dataset.digest, "split": split, "method": completer.name}
    there = claim(out, PREDICTIONS, {**about, "weights": completer.digest, "samples": PART})
    parts = [
        (f"{stem_of(split, number)}.h5", numbers)
        for number, numbers in enumerate(chunked(range(count), PART))
    ]
    # a runtime's threads do not outlive a fork: each process opens the network by itself
    asked = completer if execute is None else completer.opened
    execute = execute or ALONE
    tasks = [part for part in execute.mine(parts) if part[0] not in there]
    work, total = partial(_write, asked, samples, about, out), sum(len(n) for _, n in tasks)
    several = counted(execute, work, tasks, total=total, on_start=on_start, on_done=on_done)
    return [far for some in several for far in some if far is not None]


def _write(
    asked: Completer | tuple[str, str, int],
    samples: Split,
    about: Mapping[str, Any],
    out: Path,
    part: tuple[str, Sequence[int]],
) -> list[float | None]:
    """Write the predictions of some samples, by their numbers, into a file of the folder `out`,
    whole or not, by the network that is given, or is opened now. How far from home each is; None
    where nobody knows."""
    completer = opened_once(*asked) if isinstance(asked, tuple) else asked
    (file_name, numbers), grid = part, samples.dataset.grid
    names = "observed", *completer.inputs
    who: list[tuple[int, int]] = []
    away: list[float | None] = []
    make_parent(out / file_name)
    with new_hdf5(out / file_name) as file:
        file.attrs.update(about)
        for first in range(0, len(numbers), completer.batch):
            batch = [samples[number] for number in numbers[first : first + completer.batch]]
            inputs = [channels(names, sample, grid, sample.lidar) for sample in batch]
            prediction = completer(
                {name: np.stack([maps[name] for maps in inputs]) for name in names}
            )
            for name in STORED:
                maps = getattr(prediction, name)
                if maps is None:
                    continue
                if name not in file:
                    full, chunk = (len(numbers), *grid.shape), (1, *grid.shape)
                    file.create_dataset(name, full, np.float32, chunks=chunk, **PACKED)
                for row, values in enumerate(maps, first):
                    file[name].id.write_direct_chunk((row, 0, 0, 0), compress(values))
            who += [(sample.world, sample.viewpoint) for sample in batch]
            far = prediction.away
            away += [None] * len(batch) if far is None else far.tolist()
        file["world"], file["viewpoint"] = np.array(who, np.int64).T
    return away


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


def read_guarded(
    read: Callable[[Path], Any], path: Path, most_bytes: int, seconds: float = GUARD_S
) -> Any:
    """What `read` makes of a stranger's HDF5 file, `guarded`.

    Args:
        read: Opens the file by its path; the result must be picklable.
        path: A regular file; a pipe is refused.
        most_bytes: The largest file that is read.
        seconds: How long `read` may take.

    Raises:
        DatasetError: The file is missing or too large, or HDF5 crashes, hangs or swells on it.
        ScenegenError: Whatever `read` raises.
    """
    open_bounded(path, most_bytes).close()
    try:
        return guarded(read, path, seconds=seconds, memory_bytes=GUARD_BYTES)
    except GuardError as error:
        raise DatasetError(f"{path}: cannot be read as HDF5 ({error})") from None


def prediction_facts(path: Path) -> Json:
    """An HDF5 file of predictions, of a split or of one scan, or the first one of a folder: who
    made them, and what is in it. Raises DatasetError."""
    if path.is_dir():
        path = min(path.glob("*.h5"), default=path / PREDICTIONS)
    return read_guarded(_facts, path, 1 << 62)


def _facts(path: Path) -> Json:
    with h5py.File(path, "r") as file:
        about = {
            name: printable(file.attrs[name])[:100]
            for name in ("method", "split", "dataset")
            if name in file.attrs
        }
        parts = {name: list(file[name].shape) for name in STORED if name in file}
        if "occupancy" in file:  # the truth, which no predictions hold
            raise DatasetError(
                f"{path}: is a shard of a dataset; inspect its folder, {path.parent}"
            )
    if not parts:
        raise DatasetError(f"{path}: holds no predictions; expected {' or '.join(PARTS)}")
    return {
        "predictions": str(path),
        **about,
        "of": "a split" if "split" in about else "a scan",
        "arrays": parts,
    }
