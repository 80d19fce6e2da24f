"""Completions on disk: a whole split of a dataset, or one scan that somebody recorded."""

import math
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike

from lidarsim import GridSpec
from lidarsim.parameters import MOST_LENGTH_M
from scenegen.dataset.hdf5 import read_guarded
from scenegen.dataset.read import Dataset, Rows, Split
from scenegen.dataset.shard import compress
from scenegen.display.look import Look
from scenegen.errors import DatasetError, GuardError, empty_split
from scenegen.files import make_parent, open_bounded, remove_drafts, write_whole
from scenegen.limits import GUARD_BYTES, GUARD_S, MOST_SCAN_BYTES, MOST_VOXELS
from scenegen.model.calibration import RISK
from scenegen.model.completion.completer import Completer, opened_once
from scenegen.model.completion.parts import Chunks, Kept, new_hdf5, write_predictions
from scenegen.model.completion.points import read_points
from scenegen.model.completion.protocol import PARTS, SURE, Prediction, check_prediction
from scenegen.model.config import Thresholds
from scenegen.model.inputs import PointScan, channels, input_called
from scenegen.run import Executor
from scenegen.run.workers import guarded

PLY_HEAD = b"ply\nformat binary_little_endian 1.0\ncomment scenegen complete\n"
"""How the point clouds begin that are written here."""
PART = 40
"""Samples of a part, about, where an executor has a split completed."""


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
) -> int:
    """Complete every sample of a split and write what docs/bench.md calls a predictions file to
    `out`, whole or not; how many samples are missing yet.

    This process does it, `batch` maps at once; or `execute` has parts of it done, on one thread
    each, which are kept in a folder beside `out` until all are there: none is missing for the run
    that finds them so, and joins them. Raises DatasetError for another grid, an empty split, a disk
    that refuses, or where `out` is something else already.
    """
    check_output(out)
    dataset = Dataset(folder)
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
    every = [
        Rows(split, range(first, min(first + each, len(samples))))
        for first in range(0, len(samples), each)
    ]
    if execute is None:
        on_start(len(samples))
        made = ((rows, _completed(completer, samples, batch, rows)) for rows in every)
        write_predictions(out, samples, completer, (_counted(on_done, *one) for one in made))
        return 0
    assert completer.opened is not None
    kept = Kept.beside(out, samples, completer, batch)
    mine = execute.mine(every)
    missing = [rows for rows in mine if not kept.path(rows).exists()]
    on_done(_count(mine) - _count(missing))
    make_parent(kept.path(every[0]))
    work = partial(_keep, completer.opened, samples, batch, kept)
    with closing(execute(work, missing, lambda: on_start(_count(mine)))) as results:
        for count in results:
            on_done(count)
    if absent := [rows for rows in every if not kept.path(rows).exists()]:
        return _count(absent)
    try:
        write_predictions(out, samples, completer, map(kept.read, every))
    except DatasetError:  # unless another rank, which ended at the same time, has joined them
        if kept.folder.exists() or not out.exists():
            raise
    else:
        with suppress(
            OSError
        ):  # another rank may be doing it, and a user may have put something there
            for rows in every:
                kept.path(rows).unlink(missing_ok=True)
            remove_drafts(kept.folder)
            kept.folder.rmdir()
    return 0


def _count(parts: Iterable[Rows]) -> int:
    return sum(len(rows.numbers) for rows in parts)


def _completed(completer: Completer, samples: Split, batch: int, rows: Rows) -> Chunks:
    """The maps of `rows`, completed `batch` at once."""
    found: Chunks = {}
    dataset = samples.dataset
    for first in range(0, len(rows.numbers), batch):
        numbers = rows.numbers[first : first + batch]
        read = [
            channels(completer.inputs, samples[number], dataset.grid, dataset.lidar)
            for number in numbers
        ]
        said = completer({name: np.stack([one[name] for one in read]) for name in completer.inputs})
        for name in PARTS | SURE:
            if (maps := getattr(said, name)) is not None:
                found.setdefault(name, []).extend(compress(values) for values in maps)
    return found


def _counted(on_done: Callable[[int], None], rows: Rows, chunks: Chunks) -> Chunks:
    on_done(len(rows.numbers))
    return chunks


def _keep(opened: tuple[str, str, int], samples: Split, batch: int, kept: Kept, rows: Rows) -> int:
    """Complete a part into its file. How many samples it has."""
    kept.write(
        rows, _completed(opened_once(*opened), samples, batch, rows), samples.dataset.grid.shape
    )
    return len(rows.numbers)


def predict_scan(
    completer: Completer,
    scan: Path,
    out: Path,
    *,
    sensor: ArrayLike = (0.0, 0.0, 0.0),
    thresholds: Thresholds,
) -> str:
    """Complete one scan: points in metres, z up, in a level frame where the sensor is at `sensor`
    (3,). Returns in words how many points came into its map.

    `out` is HDF5 (``.h5``: the network's inputs, what is predicted, and the grid) or a point cloud
    (``.ply``: the centres of the voxels that are occupied at `thresholds`, in the scan's frame).
    Raises DatasetError for files that are not such, and where `out` is something else already.
    """
    if out.suffix not in (".h5", ".ply"):
        raise DatasetError(f"{out}: expected a name that ends in .h5 or .ply")
    check_output(out)
    place = np.asarray(sensor, dtype=np.float64)
    if not (np.abs(place) <= MOST_LENGTH_M).all():
        raise DatasetError(
            f"--sensor {place.tolist()}: expected metres within {MOST_LENGTH_M:g} of the origin"
        )
    points = read_points(scan)
    returned = points[np.isfinite(points).all(axis=1)]
    seen = PointScan(points=returned, position=place, grid=completer.grid)
    inside = len(seen.voxels)
    used = (
        f"{inside} of {len(points)} points used, {len(points) - len(returned)} without a return, "
        + (f"{len(returned) - inside} outside the map")
    )
    if not inside:
        extent = " × ".join(f"{metres:g}" for metres in completer.grid.extent_m)
        raise DatasetError(
            f"{scan}: {used}, which is {extent} m around the sensor at {place.tolist()}; give "
            f"--sensor, and metres"
        )
    untold = [input_called(name).untold for name in completer.inputs]
    used += "".join(f"; {what}" for what in untold if what)
    maps = channels(completer.inputs, seen, seen.grid)
    prediction = completer(maps)
    if out.suffix == ".ply":
        centres = seen.grid.centres(seen.origin)[prediction.occupied(thresholds)]
        header = f"element vertex {len(centres)}\n" + "".join(
            f"property float {axis}\n" for axis in "xyz"
        )
        write_whole(
            out, PLY_HEAD + header.encode() + b"end_header\n" + centres.astype("<f4").tobytes()
        )
        return used
    with new_hdf5(out) as file:
        file.attrs.update(
            {"method": completer.name, "origin": seen.origin, "voxel": seen.grid.voxel_m}
        )
        if prediction.uncertainty is not None:
            file.attrs["risk"] = RISK
        for name, values in (
            maps | {name: getattr(prediction, name) for name in PARTS | SURE}
        ).items():
            if values is not None:
                file[name] = values
    return used


def read_completion(path: Path) -> Look:
    """What `predict_scan` wrote to the .h5 file `path`, to be shown: `observed`, `predicted` at the
    paper's thresholds, and the distances. Raises DatasetError for anything else."""
    return read_guarded(_completion, path, MOST_SCAN_BYTES)


def _completion(path: Path) -> Look:
    advice = (
        "expected what `scenegen complete` wrote of a scan; of a split: scenegen render DATASET "
        "--predictions FILE"
    )
    try:
        with h5py.File(path, "r") as file:
            origin, voxel_m = np.array(file.attrs["origin"], np.float64), float(file.attrs["voxel"])
            names = [name for name in ("observed", *PARTS) if name in file]
            shape = file[names[0]].shape
            if (
                len(shape) != 3
                or not 0 < math.prod(shape) <= MOST_VOXELS
                or not np.isfinite(origin).all()
            ):
                raise ValueError("no map")
            grid = GridSpec(shape=shape, voxel_m=voxel_m)
            maps = {name: np.asarray(file[name]) for name in names}
        parts: Any = {name: maps[name].astype(np.float32) for name in PARTS if name in maps}
        said = check_prediction(Prediction(**parts), shape, str(path))
        place = origin + np.array(grid.extent_m) / 2
        masks = {
            "observed": maps["observed"].astype(bool),
            "predicted": said.occupied(Thresholds()),
        }
        tudf = said.distance(Thresholds(), grid)
        level = np.array([1.0, 0.0, 0.0, 0.0])
        return Look(
            name=path.name,
            grid=grid,
            origin=origin,
            position=place,
            quaternion=level,
            masks=masks,
            tudf=tudf,
        )
    except Exception:  # h5py's errors share no base
        raise DatasetError(f"{path}: holds no completion of a scan; {advice}") from None


def check_output(out: Path) -> None:
    """Raise DatasetError where something is at `out` that no completion wrote: it might be dear to
    somebody."""
    if out.exists() and not _is_completion(out):
        raise DatasetError(
            f"{out}: is there already, and no completion of scenegen's; give another -o, or "
            f"remove it"
        )


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
