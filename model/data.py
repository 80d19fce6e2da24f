"""Datasets as torch sees them: maps by number, batches in a seeded order, distances derived where the batch is."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from lidarsim import GridSpec
from scenegen.dataset.read import Dataset as SampleDataset
from scenegen.errors import DatasetError
from scenegen.truth import distance_field

SYMMETRIES = 8
"""Rotations by quarter turns about the sensor's vertical axis, each with and without a mirror."""


class LoaderError(DatasetError):
    """A process that reads samples is gone."""


class Maps(Dataset):
    """The samples of one split of one or more datasets: ``maps[n]`` is (observed, occupancy), bool (*grid.shape) each.

    ``maps[n, s]`` is the same turned by symmetry `s`. Files are opened in the process that reads, so any number of
    loader workers is safe. Raises DatasetError for datasets that do not go together.
    """

    def __init__(self, folders: Sequence[Path | str], split: str):
        if not folders:
            raise DatasetError("no dataset given; make one with `scenegen generate --kind pillar`")
        self.split = split
        self.datasets = [SampleDataset(folder) for folder in folders]
        check_alike(self.datasets)
        self.grid = self.datasets[0].grid
        self._splits = [dataset.split(split) for dataset in self.datasets]
        self._start = np.cumsum([0, *map(len, self._splits)])

    def __len__(self) -> int:
        return int(self._start[-1])

    def __getitem__(self, key: int | tuple[int, int]) -> tuple[Tensor, Tensor]:
        index, symmetry = key if isinstance(key, tuple) else (key, 0)
        part, row = self._place(index)
        sample = part[row]
        observed, occupancy = turned(sample.observed, symmetry), turned(sample.occupancy, symmetry)
        return torch.from_numpy(observed), torch.from_numpy(occupancy)

    def name(self, index: int) -> str:
        """Who sample `index` is, for people: folder, split, number."""
        part, row = self._place(index)
        return f"{part.dataset.folder}, {self.split} sample {row}"

    def _place(self, index: int) -> tuple[Any, int]:
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        number = int(np.searchsorted(self._start, index, side="right")) - 1
        return self._splits[number], index - int(self._start[number])


def check_alike(datasets: Sequence[SampleDataset]) -> None:
    """Raise DatasetError unless all `datasets` have one grid and one sensor, and none is there twice."""
    first = datasets[0]
    for other in datasets[1:]:
        for what in ("grid", "lidar"):
            if getattr(other, what) != getattr(first, what):
                raise DatasetError(
                    f"{other.folder}: its {what} is {getattr(other, what)}, that of {first.folder} is "
                    f"{getattr(first, what)}; one network takes one {what}: train on datasets that share it"
                )
    seen: dict[str, Path] = {}
    for dataset in datasets:
        digest = str(dataset.manifest.digest)
        if digest in seen:
            raise DatasetError(f"{dataset.folder}: holds the same samples as {seen[digest]}; name one of the two")
        seen[digest] = dataset.folder


def turned(grid: np.ndarray, symmetry: int) -> np.ndarray:
    """A map (X, Y, Z) turned by symmetry 0 to 7: `symmetry` % 4 quarter turns about z, mirrored in y from 4 on.

    The sensor's place, the centre, stays where it is. Odd turns need a map as long in x as in y.
    """
    if symmetry >= SYMMETRIES // 2:
        grid = grid[:, ::-1]
    return np.ascontiguousarray(np.rot90(grid, symmetry % 4, axes=(0, 1)))


def epoch_batches(
    maps: Maps, *, batch: int, seed: int, epoch: int, augment: bool = False
) -> list[list[tuple[int, int]]]:
    """The batches of a training epoch: keys of `Maps`, in an order that depends on `seed` and `epoch` alone.

    A last batch that is not full is left out, unless it is the only one.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(epoch,)))
    order = rng.permutation(len(maps))
    turns = rng.integers(SYMMETRIES, size=len(maps)) if augment else np.zeros(len(maps), dtype=int)
    if augment and maps.grid.shape[0] != maps.grid.shape[1]:
        turns = turns // 2 * 2  # no quarter turns of a map that is longer than wide
    keys = list(zip(order.tolist(), turns.tolist(), strict=True))
    count = max(len(keys) // batch, 1)
    return [keys[n * batch : (n + 1) * batch] for n in range(count)]


def load(
    maps: Maps, batches: Sequence[Sequence[Any]], *, workers: int, pinned: bool
) -> Iterator[tuple[Tensor, Tensor]]:
    """(observed, occupancy) of every batch in turn, bool (B, *grid.shape) each, read by `workers` processes; 0 for
    none. Raises DatasetError for what cannot be read, LoaderError where such a process dies."""
    loader: DataLoader = DataLoader(maps, batch_sampler=batches, num_workers=workers, pin_memory=pinned)
    try:
        yield from loader
    except DatasetError as error:  # a loader process hands over its traceback with it
        line = str(error).strip().splitlines()[-1]
        raise DatasetError(line.removeprefix(f"{DatasetError.__module__}.{DatasetError.__name__}: ")) from None
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise LoaderError(
            f"a loader process died ({str(error).splitlines()[0]}); give --workers 0, or more shared memory"
        ) from None


class TudfOf:
    """Occupancy → TUDF, for a batch, wherever it is.

    On the CPU by `scenegen.truth.distance_field`, map by map; elsewhere by the same three passes of minima in torch.
    Both give the values that the dataset's contract demands, bit for bit.
    """

    def __init__(self, grid: GridSpec):
        self.grid = grid
        reach = grid.truncation_m / grid.voxel_m
        self._reach = math.ceil(reach)
        squares = np.arange(3 * (self._reach + 1) ** 2 + 1, dtype=np.float64)
        metres = np.minimum(grid.voxel_m * np.sqrt(squares), grid.truncation_m)
        self._table = torch.from_numpy(metres.astype(np.float32))

    def __call__(self, occupancy: Tensor) -> Tensor:
        """(B, *grid.shape) bool → float32, metres."""
        if occupancy.device.type == "cpu":
            fields = [distance_field(one, self.grid) for one in occupancy.numpy()]
            return torch.from_numpy(np.stack(fields))
        return self.by_minima(occupancy)

    def by_minima(self, occupancy: Tensor) -> Tensor:
        """The same on any device: squared distances in voxels, lowered along one axis after the other."""
        cap = (self._reach + 1) ** 2
        squares = torch.where(occupancy, 0, cap).to(torch.int16 if 2 * cap < 2**15 else torch.int32)
        for axis in (1, 2, 3):
            length = squares.shape[axis]
            lowest = squares.clone()
            for offset in range(1, min(self._reach, length - 1) + 1):
                near, far = lowest.narrow(axis, 0, length - offset), lowest.narrow(axis, offset, length - offset)
                torch.minimum(near, squares.narrow(axis, offset, length - offset) + offset**2, out=near)
                torch.minimum(far, squares.narrow(axis, 0, length - offset) + offset**2, out=far)
            squares = lowest
        return self._table.to(occupancy.device)[squares.long()]
