"""Completions on disk: a whole split of a dataset, or one scan that somebody recorded."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim import GridSpec
from lidarsim.limits import MOST_LENGTH_M
from scenegen.dataset.read import Dataset
from scenegen.dataset.shard import compress
from scenegen.errors import DatasetError, GuardError, empty_split
from scenegen.files import open_bounded, whole, write_whole
from scenegen.limits import GUARD_BYTES, GUARD_S
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.points import read_points
from scenegen.model.completion.protocol import PARTS, Prediction
from scenegen.model.config import Thresholds
from scenegen.model.inputs import PointScan, of_sample, of_scan
from scenegen.workers import guarded

PLY_HEAD = b"ply\nformat binary_little_endian 1.0\ncomment scenegen complete\n"
"""How the point clouds begin that are written here."""


@dataclass(frozen=True, kw_only=True)
class Used:
    """How many points of a scan came into its map."""

    points: int
    returned: int
    """Points that are finite; the others are rays that returned nothing."""
    inside: int
    """Points that lie in the map."""

    def __str__(self) -> str:
        return f"{self.inside} of {self.points} points used, {self.points - self.returned} without a return, " + (
            f"{self.returned - self.inside} outside the map"
        )


def predict_split(
    completer: Completer,
    folder: Path,
    split: str,
    out: Path,
    *,
    batch: int = 8,
    on_start: Callable[[int], None] = lambda total: None,
    on_done: Callable[[int], None] = lambda samples: None,
) -> None:
    """Complete every sample of a split and write what docs/bench.md calls a predictions file to `out`, whole or not.

    Raises DatasetError for another grid, an empty split, a disk that refuses, or where `out` is something else
    already.
    """
    check_output(out)
    dataset = Dataset(folder)
    check_grid(completer, dataset.grid, folder)
    samples = dataset.split(split)
    if not len(samples):
        raise DatasetError(f"{folder}: {empty_split(split)}, or give another --split")
    names = samples.names

    def maps(row: int) -> dict[str, NDArray[Any]]:
        return of_sample(completer.inputs, samples[row], dataset.grid, dataset.lidar)

    on_start(len(samples))
    with whole(out) as draft, h5py.File(draft, "w") as file:
        file.attrs.update({"dataset": dataset.manifest.digest, "split": split, "method": completer.name})
        file["world"] = np.array([world for _, world, _ in names], dtype=np.int64)
        file["viewpoint"] = np.array([viewpoint for _, _, viewpoint in names], dtype=np.int64)
        for first in range(0, len(samples), batch):
            read = [maps(row) for row in range(first, min(first + batch, len(samples)))]
            stacked = {name: np.stack([one[name] for one in read]) for name in completer.inputs}
            _write(file, completer(stacked), first, len(samples))
            on_done(len(read))


def predict_scan(
    completer: Completer, scan: Path, out: Path, *, sensor: ArrayLike = (0.0, 0.0, 0.0), thresholds: Thresholds
) -> Used:
    """Complete one scan: points in metres, z up, in a level frame where the sensor is at `sensor` (3,).

    `out` is HDF5 (``.h5``: the network's inputs, what is predicted, and the grid) or a point cloud (``.ply``: the
    centres of the voxels that are occupied at `thresholds`, in the scan's frame). Raises DatasetError for files that
    are not such, and where `out` is something else already.
    """
    if out.suffix not in WRITERS:
        raise DatasetError(f"{out}: expected a name that ends in {' or '.join(WRITERS)}")
    check_output(out)
    place = np.asarray(sensor, dtype=np.float64)
    if not (np.abs(place) <= MOST_LENGTH_M).all():
        raise DatasetError(f"--sensor {place.tolist()}: expected metres within {MOST_LENGTH_M:g} of the origin")
    points = read_points(scan)
    returned = points[np.isfinite(points).all(axis=1)]
    seen = PointScan(points=returned, sensor=place, grid=completer.grid)
    used = Used(points=len(points), returned=len(returned), inside=len(seen.voxels))
    if not used.inside:
        raise DatasetError(
            f"{scan}: {used}, a map of {completer.grid.extent_m} m around the sensor at {place.tolist()}; "
            "give --sensor, and metres"
        )
    maps = of_scan(completer.inputs, seen)
    WRITERS[out.suffix](CompletedScan(completer.name, seen, maps, completer(maps), thresholds), out)
    return used


def check_output(out: Path) -> None:
    """Raise DatasetError where something is at `out` that no completion wrote: it might be dear to somebody."""
    if out.exists() and not _is_completion(out):
        raise DatasetError(f"{out}: is there already, and no completion of scenegen's; give another -o, or remove it")


def _is_completion(path: Path) -> bool:
    try:
        with open_bounded(path, 1 << 62) as file:
            if file.read(len(PLY_HEAD)) == PLY_HEAD:
                return True
        return guarded(_names_a_method, path, seconds=GUARD_S, memory_bytes=GUARD_BYTES)
    except (DatasetError, GuardError, FileNotFoundError):
        return False


def _names_a_method(path: Path) -> bool:
    try:
        with h5py.File(path, "r") as file:
            return "method" in file.attrs and ("origin" in file.attrs or "split" in file.attrs)
    except (OSError, RuntimeError):
        return False


def check_grid(completer: Completer, grid: GridSpec, where: Path) -> None:
    """Raise DatasetError unless a network completes maps on `grid`."""
    if grid != completer.grid:
        raise DatasetError(
            f"{where}: its maps are on {grid}, {completer.name} completes maps on {completer.grid}; train a network on "
            "this grid with `scenegen train`"
        )


def _write(file: h5py.File, prediction: Prediction, row: int, total: int) -> None:
    for name in PARTS:
        values: Any = getattr(prediction, name)
        if values is None:
            continue
        if name not in file:
            shape = values.shape[1:]
            file.create_dataset(
                name, (total, *shape), np.float32, chunks=(1, *shape), compression="gzip", compression_opts=1
            )
        for n, value in enumerate(values):
            file[name].id.write_direct_chunk((row + n, 0, 0, 0), compress(value))


@dataclass(frozen=True)
class CompletedScan:
    """One scan, and what `method` says of its map."""

    method: str
    scan: PointScan
    maps: dict[str, NDArray[Any]]
    """What the method was shown, by name."""
    prediction: Prediction
    thresholds: Thresholds

    def write_h5(self, out: Path) -> None:
        """Write everything as HDF5."""
        with whole(out) as draft, h5py.File(draft, "w") as file:
            file.attrs.update({"method": self.method, "origin": self.scan.origin, "voxel": self.scan.grid.voxel_m})
            for name, values in self.maps.items():
                file[name] = values
            for name in PARTS:
                if getattr(self.prediction, name) is not None:
                    file[name] = getattr(self.prediction, name)

    def write_ply(self, out: Path) -> None:
        """Write the centres of the voxels that are occupied as a cloud of points in the scan's frame."""
        centres = self.scan.grid.centres(self.scan.origin)[self.prediction.occupied(self.thresholds)]
        header = f"element vertex {len(centres)}\n" + "".join(f"property float {axis}\n" for axis in "xyz")
        write_whole(out, PLY_HEAD + header.encode() + b"end_header\n" + centres.astype("<f4").tobytes())


WRITERS = {".h5": CompletedScan.write_h5, ".ply": CompletedScan.write_ply}
"""File types of a completed scan."""
