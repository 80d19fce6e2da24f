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
from scenegen.errors import DatasetError, GuardError
from scenegen.files import open_bounded, whole, write_whole
from scenegen.limits import GUARD_BYTES, GUARD_S
from scenegen.model.bench.methods import empty_split
from scenegen.model.bench.predicted import FIELDS
from scenegen.model.complete import Prediction, Thresholds
from scenegen.model.completer import Completer
from scenegen.model.data import Maps, load
from scenegen.model.points import read_points
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
    workers: int = 0,
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
    maps = Maps([folder], split)
    if not len(maps):
        raise DatasetError(f"{folder}: {empty_split(split)}, or give another --split")
    names = dataset.split(split).names
    batches = [list(range(n, min(n + batch, len(maps)))) for n in range(0, len(maps), batch)]
    on_start(len(maps))
    with whole(out) as draft, h5py.File(draft, "w") as file:
        file.attrs.update({"dataset": dataset.manifest["digest"], "split": split, "method": completer.name})
        file["world"] = np.array([world for _, world, _ in names], dtype=np.int64)
        file["viewpoint"] = np.array([viewpoint for _, _, viewpoint in names], dtype=np.int64)
        for rows, (observed, _) in zip(batches, load(maps, batches, workers=workers, pinned=False), strict=True):
            _write(file, completer(observed.numpy()), rows[0], len(maps))
            on_done(len(rows))


def predict_scan(
    completer: Completer, scan: Path, out: Path, *, sensor: ArrayLike = (0.0, 0.0, 0.0), thresholds: Thresholds
) -> Used:
    """Complete one scan: points in metres, z up, in a level frame where the sensor is at `sensor` (3,).

    `out` is HDF5 (``.h5``: `observed`, what is predicted, and the grid) or a point cloud (``.ply``: the centres of the
    voxels that are occupied at `thresholds`, in the scan's frame). Raises DatasetError for files that are not such,
    and where `out` is something else already.
    """
    if out.suffix not in WRITERS:
        raise DatasetError(f"{out}: expected a name that ends in {' or '.join(WRITERS)}")
    check_output(out)
    place = np.asarray(sensor, dtype=np.float64)
    if not (np.abs(place) <= MOST_LENGTH_M).all():
        raise DatasetError(f"--sensor {place.tolist()}: expected metres within {MOST_LENGTH_M:g} of the origin")
    points = read_points(scan)
    returned = points[np.isfinite(points).all(axis=1)]
    origin = completer.grid.origin_at(place)
    observed, inside = mark(returned, origin, completer.grid)
    used = Used(points=len(points), returned=len(returned), inside=inside)
    if not inside:
        raise DatasetError(
            f"{scan}: {used}, a map of {completer.grid.extent_m} m around the sensor at {place.tolist()}; "
            "give --sensor, and metres"
        )
    WRITERS[out.suffix](out, completer, origin, observed, completer(observed), thresholds)
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


def mark(points: NDArray[np.float64], origin: NDArray[np.float64], grid: GridSpec) -> tuple[NDArray[np.bool_], int]:
    """The voxels, (*grid.shape), that hold one of the finite `points` (N, 3), and how many points lie in the map."""
    near = points[(np.abs(points) <= 2 * MOST_LENGTH_M).all(axis=1)]  # voxels of those beyond have no whole numbers
    index = grid.index(near, origin)
    inside = ((index >= 0) & (index < grid.shape)).all(axis=1)
    observed = np.zeros(grid.shape, dtype=np.bool_)
    observed[tuple(index[inside].T)] = True
    return observed, int(inside.sum())


def _write(file: h5py.File, prediction: Prediction, row: int, total: int) -> None:
    for name in FIELDS:
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


def _write_h5(
    out: Path,
    completer: Completer,
    origin: NDArray[np.float64],
    observed: NDArray[np.bool_],
    prediction: Prediction,
    thresholds: Thresholds,
) -> None:
    with whole(out) as draft, h5py.File(draft, "w") as file:
        file.attrs.update({"method": completer.name, "origin": origin, "voxel": completer.grid.voxel_m})
        file["observed"] = observed
        for name in FIELDS:
            if getattr(prediction, name) is not None:
                file[name] = getattr(prediction, name)


def _write_ply(
    out: Path,
    completer: Completer,
    origin: NDArray[np.float64],
    observed: NDArray[np.bool_],
    prediction: Prediction,
    thresholds: Thresholds,
) -> None:
    centres = completer.grid.centres(origin)[prediction.occupied(thresholds)]
    header = f"element vertex {len(centres)}\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    write_whole(out, PLY_HEAD + header.encode() + b"end_header\n" + centres.astype("<f4").tobytes())


WRITERS = {".h5": _write_h5, ".ply": _write_ply}
"""File types of a completed scan."""
