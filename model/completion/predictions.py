"""Completions on disk: a whole split of a dataset, or one scan that somebody recorded."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike

from lidarsim import GridSpec
from lidarsim.limits import MOST_LENGTH_M
from scenegen.dataset.foreign import read_guarded
from scenegen.dataset.read import Dataset
from scenegen.dataset.shard import compress
from scenegen.errors import DatasetError, GuardError, empty_split
from scenegen.files import open_bounded, whole, write_whole
from scenegen.limits import GUARD_BYTES, GUARD_S, MOST_SCAN_BYTES, MOST_VOXELS
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.points import read_points
from scenegen.model.completion.protocol import PARTS, SURE, Prediction, check_prediction
from scenegen.model.config import Thresholds
from scenegen.model.inputs import PointScan, of_sample, of_scan
from scenegen.model.uncertainty.calibration import RISK
from scenegen.view.look import Look
from scenegen.workers import guarded

PLY_HEAD = b"ply\nformat binary_little_endian 1.0\ncomment scenegen complete\n"
"""How the point clouds begin that are written here."""


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
    if dataset.grid != completer.grid:
        raise DatasetError(
            f"{folder}: its maps are on {dataset.grid}, {completer.name} completes maps on {completer.grid}; train a "
            "network on this grid with `scenegen train`"
        )
    samples = dataset.split(split)
    if not len(samples):
        raise DatasetError(f"{folder}: {empty_split(split)}, or give another --split")
    names = samples.names

    on_start(len(samples))
    with whole(out) as draft, h5py.File(draft, "w") as file:
        file.attrs.update({"dataset": dataset.manifest.digest, "split": split, "method": completer.name})
        file["world"] = np.array([world for _, world, _ in names], dtype=np.int64)
        file["viewpoint"] = np.array([viewpoint for _, _, viewpoint in names], dtype=np.int64)
        for first in range(0, len(samples), batch):
            rows = range(first, min(first + batch, len(samples)))
            read = [of_sample(completer.inputs, samples[row], dataset.grid, dataset.lidar) for row in rows]
            stacked = {name: np.stack([one[name] for one in read]) for name in completer.inputs}
            _write(file, completer(stacked), first, len(samples))
            on_done(len(read))


def predict_scan(
    completer: Completer, scan: Path, out: Path, *, sensor: ArrayLike = (0.0, 0.0, 0.0), thresholds: Thresholds
) -> str:
    """Complete one scan: points in metres, z up, in a level frame where the sensor is at `sensor` (3,). Returns in
    words how many points came into its map.

    `out` is HDF5 (``.h5``: the network's inputs, what is predicted, and the grid) or a point cloud (``.ply``: the
    centres of the voxels that are occupied at `thresholds`, in the scan's frame). Raises DatasetError for files that
    are not such, and where `out` is something else already.
    """
    if out.suffix not in (".h5", ".ply"):
        raise DatasetError(f"{out}: expected a name that ends in .h5 or .ply")
    check_output(out)
    place = np.asarray(sensor, dtype=np.float64)
    if not (np.abs(place) <= MOST_LENGTH_M).all():
        raise DatasetError(f"--sensor {place.tolist()}: expected metres within {MOST_LENGTH_M:g} of the origin")
    points = read_points(scan)
    returned = points[np.isfinite(points).all(axis=1)]
    seen = PointScan(points=returned, sensor=place, grid=completer.grid)
    inside = len(seen.voxels)
    used = f"{inside} of {len(points)} points used, {len(points) - len(returned)} without a return, " + (
        f"{len(returned) - inside} outside the map"
    )
    if "free" in completer.inputs:
        used += "; of rays without a return nothing is known, so less is free than in training"
    if not inside:
        raise DatasetError(
            f"{scan}: {used}, a map of {completer.grid.extent_m} m around the sensor at {place.tolist()}; "
            "give --sensor, and metres"
        )
    maps = of_scan(completer.inputs, seen)
    prediction = completer(maps)
    if out.suffix == ".ply":
        centres = seen.grid.centres(seen.origin)[prediction.occupied(thresholds)]
        header = f"element vertex {len(centres)}\n" + "".join(f"property float {axis}\n" for axis in "xyz")
        write_whole(out, PLY_HEAD + header.encode() + b"end_header\n" + centres.astype("<f4").tobytes())
        return used
    with whole(out) as draft, h5py.File(draft, "w") as file:
        file.attrs.update({"method": completer.name, "origin": seen.origin, "voxel": seen.grid.voxel_m})
        if prediction.uncertainty is not None:
            file.attrs["risk"] = RISK
        for name, values in (maps | {name: getattr(prediction, name) for name in PARTS | SURE}).items():
            if values is not None:
                file[name] = values
    return used


def read_completion(path: Path) -> Look:
    """What `predict_scan` wrote to the .h5 file `path`, to be shown: `observed`, `predicted` at the paper's thresholds,
    and the distances. Raises DatasetError for anything else."""
    return read_guarded(_completion, path, MOST_SCAN_BYTES)


def _completion(path: Path) -> Look:
    advice = "expected what `scenegen complete` wrote of a scan; of a split: scenegen render DATASET --predictions FILE"
    try:
        with h5py.File(path, "r") as file:
            origin, voxel_m = np.array(file.attrs["origin"], np.float64), float(file.attrs["voxel"])
            names = [name for name in ("observed", *PARTS) if name in file]
            shape = file[names[0]].shape
            if len(shape) != 3 or not 0 < math.prod(shape) <= MOST_VOXELS or not np.isfinite(origin).all():
                raise ValueError("no map")
            grid = GridSpec(shape=shape, voxel_m=voxel_m)
            maps = {name: np.asarray(file[name]) for name in names}
        parts: Any = {name: maps[name].astype(np.float32) for name in PARTS if name in maps}
        said = check_prediction(Prediction(**parts), shape, str(path))
        place = origin + np.array(grid.extent_m) / 2
        masks = {"observed": maps["observed"].astype(bool), "predicted": said.occupied(Thresholds())}
        tudf = said.distance(Thresholds(), grid)
        level = np.array([1.0, 0.0, 0.0, 0.0])
        return Look(name=path.name, grid=grid, origin=origin, position=place, quaternion=level, masks=masks, tudf=tudf)
    except Exception:  # h5py's errors share no base
        raise DatasetError(f"{path}: holds no completion of a scan; {advice}") from None


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


def _write(file: h5py.File, prediction: Prediction, row: int, total: int) -> None:
    if prediction.uncertainty is not None:
        file.attrs["risk"] = RISK
    for name in PARTS | SURE:
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
