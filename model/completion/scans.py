"""Completions of real scans: of a file, of every file in a folder, or of a log with poses."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import h5py
import numpy as np
from numpy.typing import ArrayLike

from lidarsim import GridSpec
from lidarsim.grid import Floats, iou
from lidarsim.parameters import MAX_LENGTH_M
from lidarsim.pose import rotate
from lidarsim.scan import are_returns
from scenegen.base.errors import DatasetError, plural, reraise_as
from scenegen.base.files import check_ours, make_way, write_atomic
from scenegen.base.limits import MAX_SCAN_BYTES, MAX_VOXELS
from scenegen.base.paths import is_log
from scenegen.base.reading import read_bounded
from scenegen.logs import LogScan
from scenegen.logs.log import Log
from scenegen.logs.read import read_log
from scenegen.model.calibration import UNUSUAL
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.protocol import PARTS, Prediction, check_prediction
from scenegen.model.completion.stored import (
    DIGEST,
    about_others,
    check_digest,
    digest_of,
    new_hdf5,
    read_guarded,
    write_map,
)
from scenegen.model.config import PREDICTIONS, Thresholds
from scenegen.model.inputs import UNTOLD, channels
from scenegen.view.look import Guess, Look, evenly
from scenegen.worlds.clouds import READERS, ReadReport, check_scan, read_cloud, scans_in
from scenegen.worlds.clouds.write import encode_points, read_npz

MAX_LOOKS = 24
"""Completions of a folder or a log on a page, evenly spread."""
TRUTH = ("occupancy", "known")
"""Arrays that an observation of `scenegen ingest` has besides its scan, from the whole log."""
BELOW_M = 5.0
"""Horizontal distance from the sensor within which its height above the ground is measured,
metres."""
MIN_BELOW, LOWEST = 20, 0.1
"""Number of returns that the height needs, and the quantile of them that is taken for the ground.
It is the ground if the sensor looks down far enough."""


class CompletionScan(NamedTuple):
    """A scan to complete."""

    name: str
    points: Floats
    """(N, 3), metres, z up; not finite where nothing returned."""
    position: Floats
    """(3,): where the sensor is in the points' frame, metres."""
    layout: str
    """Description of the file's columns, see `Cloud`; "" for scans of a log."""
    truth: Mapping[str, Any] = {}
    """`TRUTH` in the grid around the sensor, and its `voxel_m`; nothing where only the scan is
    known."""


Task: TypeAlias = tuple[str, Callable[[], CompletionScan]]
"""Name of a completion, and a function that reads its scan, which raises DatasetError."""


@dataclass(frozen=True, kw_only=True)
class ScanReport:
    """Result of completing a scan."""

    points: int
    layout: str
    """Description of the file's columns, see `Cloud`."""
    without: int
    """Points without a return."""
    inside: int
    """Points within the map."""
    height_m: float | None
    """The sensor's above what it sees below it; None where too few returns tell it."""
    away: bool
    """Whether the map is unfamiliar to the network, see `Prediction.away`."""
    iou: float | None
    """Of the prediction at the thresholds that `predict_scan` takes, over the voxels that the truth
    knows; None without a truth."""


def read_scan(path: Path, sensor: ArrayLike, columns: int | None = None) -> CompletionScan:
    """Read the scan in a file, with the truth if it is an observation.

    Args:
        path: A file that `read_cloud` reads.
        sensor: Position of the sensor (3,), metres.
        columns: See `read_cloud`.

    Returns:
        The scan.

    Raises:
        DatasetError: The file holds no scan, or the position is out of bounds.
    """
    position = np.asarray(sensor, float)
    if not (np.abs(position) <= MAX_LENGTH_M).all():
        raise DatasetError(
            f"--sensor {position.tolist()}: expected metres within {MAX_LENGTH_M:g} of the origin"
        )
    cloud, truth = read_cloud(path, columns=columns), dict[str, Any]()
    check_scan(cloud.points, position, str(path))
    if path.suffix == ".npz":
        with suppress(ValueError):  # an archive that holds only points
            content = read_bounded(path, MAX_SCAN_BYTES)
            values = read_npz(content, *TRUTH, "voxel_m", max_bytes=MAX_VOXELS)
            truth = dict(zip((*TRUTH, "voxel_m"), values, strict=True))
    return CompletionScan(str(path), cloud.points, position, cloud.layout, truth)


def scans_of_log(log: Log, every: int) -> Iterator[Task]:
    """List scans of a log, in the frame of its poses.

    Args:
        log: The log.
        every: Take one in so many scans.

    Yields:
        A task for each scan.
    """

    def read(name: str, scan: LogScan) -> CompletionScan:
        """Move a scan into the frame of the poses.

        Args:
            name: Its name.
            scan: The scan, in the sensor's frame.

        Returns:
            The scan.
        """
        position = scan.pose.position
        points = rotate(scan.pose.quaternion, scan.points) + position
        # in the sensor's frame, points without a return are exactly 0; here, they lie at the sensor
        points[~are_returns(scan.points)] = np.nan
        return CompletionScan(name, points, position, "")

    for number, scan in enumerate(log.scans()):
        if number % every == 0:
            yield f"{number:06d}", partial(read, f"scan {number}", scan)


def predict_scan(
    completer: Completer,
    scan: CompletionScan,
    out: Path,
    *,
    name: str = "",
    thresholds: Thresholds | None = None,
) -> ScanReport:
    """Complete one scan, and write the result.

    Args:
        completer: The network.
        scan: The scan.
        out: A .h5 file, which gets the network's inputs, the prediction, the truth if there is one,
            and the grid; or a .ply file, which gets the centres of occupied voxels in the scan's
            frame.
        name: Name of the scan in the file; by default that of the scan.
        thresholds: Thresholds of the .ply file; by default the paper's.

    Returns:
        Counts of points, and how good and how familiar the completion is.

    Raises:
        DatasetError: No point is in the map, the name has another ending, or `out` is something
            else already.
    """
    if out.suffix not in (".h5", ".ply"):
        raise DatasetError(f"{out}: expected a name that ends in .h5 or .ply")
    # before the network runs: a refusal should not cost a completion
    check_ours(out)
    make_way(out)
    with reraise_as(DatasetError, f"{scan.name}: ", " (--sensor)"):
        seen = completer.scan_of(scan.points, scan.position)
    maps = channels(("observed", *completer.inputs), seen, seen.grid)
    prediction = completer(maps)
    occupied = prediction.occupied(thresholds)
    truth = _truth_of(scan, seen.grid)
    if out.suffix == ".ply":
        write_atomic(out, encode_points(".ply", seen.grid.centres(seen.origin)[occupied]))
    else:
        facts = about_scan(completer, name or scan.name)
        facts |= {"origin": seen.origin, "voxel": seen.grid.voxel_m} | about_others(prediction)
        _write(out, facts, maps | prediction.arrays() | truth)
    return ScanReport(
        points=len(scan.points),
        layout=scan.layout,
        without=len(scan.points) - len(seen.points),
        inside=len(seen.voxels),
        height_m=height_above_returns(seen.points - scan.position),
        away=(prediction.away or 0) >= UNUSUAL,
        iou=iou(occupied & truth["known"], truth["occupancy"] & truth["known"]) if truth else None,
    )


def _truth_of(scan: CompletionScan, grid: GridSpec) -> dict[str, Any]:
    """Return the truth that came with a scan; {} if it is on another grid than the network's."""
    truth = {name: np.asarray(scan.truth[name]) for name in TRUTH if scan.truth}
    fits = all(part.shape == grid.shape and part.dtype == np.bool_ for part in truth.values())
    return truth if fits and scan.truth.get("voxel_m") == grid.voxel_m else {}


def about_scan(completer: Completer, name: str) -> dict[str, Any]:
    """Return the attributes of a completion's file.

    Args:
        completer: The network.
        name: Name of the scan.

    Returns:
        By name: the method, its digest, and the scan.
    """
    return {"method": completer.name, "weights": completer.digest, "scan": name}


def _write(out: Path, facts: Mapping[str, Any], maps: Mapping[str, Any]) -> None:
    """Write a completion: maps by name."""
    with new_hdf5(out) as file:
        for name, values in maps.items():
            write_map(file, name, values)
        file.attrs.update({**facts, DIGEST: digest_of(facts, maps).hex()})


def is_intact(path: Path, facts: Mapping[str, str]) -> bool:
    """Check that a file holds the completion of a scan as it was written.

    Args:
        path: The file.
        facts: From `about_scan`.

    Returns:
        False for a damaged file, and for one of another scan or network.
    """
    try:
        return read_guarded(partial(_check, facts=facts), path, MAX_SCAN_BYTES)
    except DatasetError:
        return False


def _check(path: Path, *, facts: Mapping[str, str]) -> bool:
    with h5py.File(path, "r") as file:
        check_digest(file, list(file))
        return all(file.attrs.get(name) == value for name, value in facts.items())


def height_above_returns(points: Floats) -> float | None:
    """Estimate the sensor's height above the ground.

    Args:
        points: Returns (N, 3) relative to the sensor, metres, z up.

    Returns:
        Metres; None if too few returns lie below it.
    """
    # a quantile, since a single return far too low would decide the minimum
    below = points[(np.hypot(points[:, 0], points[:, 1]) < BELOW_M) & (points[:, 2] < 0), 2]
    return -float(np.quantile(below, LOWEST)) if len(below) >= MIN_BELOW else None


def read_completion(path: Path) -> Look:
    """Read a completion for viewers: the observed voxels, the prediction at the paper's thresholds,
    and the truth if there is one.

    Args:
        path: A .h5 file that `predict_scan` wrote.

    Returns:
        The map to show.

    Raises:
        DatasetError: It is something else.
    """
    return read_guarded(_completion, path, MAX_SCAN_BYTES)


def _completion(path: Path) -> Look:
    advice = (
        "expected what `scenegen complete` wrote of a scan; of a split: scenegen render DATASET "
        "--predictions FILE"
    )
    try:
        with h5py.File(path, "r") as file:
            origin, voxel_m = np.array(file.attrs["origin"], float), float(file.attrs["voxel"])
            names = [name for name in ("observed", *PARTS, *TRUTH) if name in file]
            shape, method = file[names[0]].shape, str(file.attrs["method"])
            if math.prod(shape) > MAX_VOXELS or not np.isfinite(origin).all():
                raise ValueError("no map")
            maps = {name: np.asarray(file[name]) for name in names}
            if DIGEST in file.attrs:
                with reraise_as(DatasetError, f"{path}: ", of=DatasetError):
                    check_digest(file, list(file))
        grid = GridSpec(shape=shape, voxel_m=voxel_m)
        parts: Any = {name: maps[name].astype(np.float32) for name in PARTS if name in maps}
        prediction = check_prediction(Prediction(**parts), shape, str(path))
        guess = Guess(
            name=method,
            # of an observation, only known voxels are shown, as in its truth
            occupied=prediction.occupied() & maps.get("known", np.ones(shape)).astype(bool),
            tudf=prediction.distance(None, grid),
            chance=prediction.chance,
        )
        known = maps["known"].astype(bool) if "known" in maps else None
        return Look(
            name=path.stem,
            grid=grid,
            origin=origin,
            position=origin + grid.extent_m / 2,
            quaternion=np.array([1.0, 0.0, 0.0, 0.0]),
            masks={
                name: maps[name].astype(bool) for name in ("observed", "occupancy") if name in maps
            },
            known=known,
            scored=known,
            guesses=(guess,),
        )
    except DatasetError:
        raise
    except Exception:  # h5py's errors share no base
        raise DatasetError(f"{path}: holds no completion of a scan; {advice}") from None


def looks_of_completion(path: Path) -> list[Look]:
    """Read the completion of a scan, or some of a folder; see `read_completion`.

    Raises:
        DatasetError: The folder holds none, or predictions of a dataset.
    """
    if not path.is_dir():
        return [read_completion(path)]
    files = sorted(path.rglob("*.h5"))
    if (path / PREDICTIONS).exists() or not files:
        raise DatasetError(
            f"{path}: holds predictions of a dataset's split, which need the dataset: scenegen "
            f"view DATASET --split test --predictions {path}"
        )
    return looks_of_completions(files)


def looks_of_completions(files: Sequence[Path]) -> list[Look]:
    """Read some of many completions, evenly spread."""
    return [read_completion(files[n]) for n in evenly(len(files), MAX_LOOKS)]


def read_line(reports: Sequence[ScanReport]) -> str:
    """Describe in one line how the points of completed scans were read; of a log, which `Log.line`
    describes, only the number of points without a return."""
    read = ReadReport()
    for scan in reports:
        read.add(scan.points, scan.layout, scan.without)
    return str(read) if any(read.layouts) else f"{read.dropped:,} points without a return"


def summary(completer: Completer, reports: Sequence[ScanReport]) -> list[str]:
    """Summarise completed scans in lines.

    Args:
        completer: The network.
        reports: A report of each scan.

    Returns:
        The lines.
    """
    points, without, inside = (
        sum(getattr(scan, name) for scan in reports) for name in ("points", "without", "inside")
    )
    lines = [
        f"{inside} of {points} points used, {without} without a return, "
        f"{points - without - inside} outside the map"
    ]
    heights = [scan.height_m for scan in reports if scan.height_m is not None]
    lines.append("too few returns lie below the sensor to tell its height")
    if heights:
        low, high = (f"{end:.1f}" for end in (min(heights), max(heights)))
        height = low if low == high else f"{low} to {high}"
        lines[-1] = f"the sensor is some {height} m above what it sees below it"
    # points do not tell all that the network was trained with, so its user should know
    lines += [UNTOLD[name] for name in completer.inputs if name in UNTOLD]
    if away := sum(scan.away for scan in reports):
        lines.append(
            f"{completer.name} denies an unusual share of the returns of {away} of "
            f"{plural(len(reports), 'scans')}, as where it is away from home"
        )
    if ious := [scan.iou for scan in reports if scan.iou is not None]:
        lines.append(
            f"IoU {np.mean(ious):.3f} at the paper's threshold, over what the log knows "
            f"({plural(len(ious), 'observations')})"
        )
    return lines


def tasks_of(
    path: Path,
    sensor: ArrayLike,
    every: int,
    columns: int | None,
    **reading: Any,
) -> tuple[int, Iterable[Task], str]:
    """List the scans of a log or a folder that are to be completed.

    Args:
        path: The log or folder.
        sensor: Position of the sensor in files of points, (3,), metres.
        every: Take one in so many scans.
        columns: See `read_cloud`.
        reading: Arguments of `read_log`.

    Returns:
        The number of scans, a task for each, and a line on how the log was read.

    Raises:
        DatasetError: A folder holds no scans.
    """
    if reading["poses"] is not None or is_log(path):
        log = read_log(path, columns=columns, **reading)
        return len(range(0, len(log.poses), every)), scans_of_log(log, every), log.line()
    observations = path / "observations"  # what `ingest` keeps beside its maps
    scans = scans_in(observations if observations.is_dir() else path)[::every]
    if not scans:
        raise DatasetError(
            f"{path}: holds neither a dataset (no dataset.json) nor scans; expected "
            f"{', '.join(READERS)} files"
        )
    names = [str(scan.relative_to(path).with_suffix("")) for scan in scans]
    # a.pcd and a.ply of one folder would write one file, the later one over the earlier
    if len(set(names)) < len(names):
        twice = max(names, key=names.count)
        raise DatasetError(
            f"{path}: holds several scans called {twice}, which would all be completed into "
            f"{twice}.h5; rename them"
        )
    readers = (partial(read_scan, scan, sensor, columns) for scan in scans)
    return len(scans), zip(names, readers, strict=True), ""
