"""Completions on disk: a whole split of a dataset, or one scan that somebody recorded."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim import GridSpec
from model.bench.methods import FIELDS
from model.complete import Prediction, Thresholds
from model.completer import Completer
from model.data import Maps, load
from scenegen.dataset.read import Dataset
from scenegen.dataset.shard import compress
from scenegen.errors import DatasetError
from scenegen.files import whole
from scenegen.world import one_line

POINTS = (".ply", ".xyz", ".npy")
"""File types of scans."""


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

    Raises DatasetError for another grid, an empty split, or a disk that refuses.
    """
    dataset = Dataset(folder)
    check_grid(completer, dataset.grid, folder)
    maps = Maps([folder], split)
    if not len(maps):
        raise DatasetError(f"{folder}: its {split} split is empty; generate some with --{split}")
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
) -> Prediction:
    """Complete one scan: points in metres, z up, in a level frame where the sensor is at `sensor` (3,).

    `out` is HDF5 (``.h5``: `observed`, what is predicted, and the grid) or a point cloud (``.ply``: the centres of the
    voxels that are occupied at `thresholds`, in the scan's frame). Raises DatasetError for files that are not such.
    """
    points = read_points(scan)
    origin = completer.grid.origin_at(np.asarray(sensor, dtype=np.float64))
    observed = mark(points, origin, completer.grid)
    if not observed.any():
        raise DatasetError(
            f"{scan}: none of its {len(points)} points lies within the map of {completer.grid.extent_m} m around the "
            f"sensor at {np.asarray(sensor).tolist()}; give --sensor, and metres"
        )
    prediction = completer(observed)
    if out.suffix == ".ply":
        centres = completer.grid.centres(origin)[prediction.occupied(thresholds)]
        with whole(out) as draft:
            draft.write_bytes(_as_ply(centres))
    elif out.suffix == ".h5":
        with whole(out) as draft, h5py.File(draft, "w") as file:
            file.attrs.update({"method": completer.name, "origin": origin, "voxel": completer.grid.voxel_m})
            file["observed"] = observed
            for name in FIELDS:
                if getattr(prediction, name) is not None:
                    file[name] = getattr(prediction, name)
    else:
        raise DatasetError(f"{out}: expected a name that ends in .h5 or .ply")
    return prediction


def check_grid(completer: Completer, grid: GridSpec, where: Path) -> None:
    """Raise DatasetError unless a network completes maps on `grid`."""
    if grid != completer.grid:
        raise DatasetError(
            f"{where}: its maps are on {grid}, {completer.name} completes maps on {completer.grid}; train a network on "
            "this grid with `scenegen train`"
        )


def mark(points: NDArray[np.float64], origin: NDArray[np.float64], grid: GridSpec) -> NDArray[np.bool_]:
    """The voxels, (*grid.shape), that hold one of `points` (N, 3); those outside are left out."""
    index = grid.index(points, origin)
    inside = ((index >= 0) & (index < grid.shape)).all(axis=1)
    observed = np.zeros(grid.shape, dtype=np.bool_)
    observed[tuple(index[inside].T)] = True
    return observed


def read_points(path: Path) -> NDArray[np.float64]:
    """The points of a scan, (N, 3). Raises DatasetError for a file that holds none."""
    if path.suffix not in POINTS:
        raise DatasetError(f"{path}: neither a dataset's folder nor a scan; expected one of {', '.join(POINTS)}")
    try:
        if path.suffix == ".npy":
            found = np.load(path, allow_pickle=False)
        else:
            import trimesh

            found = np.asarray(trimesh.load(path, process=False).vertices)
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except Exception as error:  # parsers of strangers' files raise anything
        raise DatasetError(f"{path}: cannot be read as {path.suffix}: {one_line(error)}") from None
    if found.ndim != 2 or found.shape[1] < 3 or not len(found) or found.dtype.kind not in "fiu":
        raise DatasetError(f"{path}: holds numbers of shape {found.shape}, expected (N, 3): x, y, z in metres")
    points = found[:, :3].astype(np.float64)
    return points[np.isfinite(points).all(axis=1)]  # what returned nothing


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


def _as_ply(points: NDArray[np.float64]) -> bytes:
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    return header.encode() + points.astype("<f4").tobytes()
