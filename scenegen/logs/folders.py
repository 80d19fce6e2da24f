"""Logs in folders of clouds: KITTI's odometry layout, or any clouds beside a file of poses."""

import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.pose import chained
from scenegen.clouds import KITTI_FOLDER, READERS, read_cloud, scans_in
from scenegen.errors import DatasetError
from scenegen.logs.bags import Reader
from scenegen.logs.log import Log, make_log, span
from scenegen.poses import (
    BEYOND_S,
    MIN_UNIX_S,
    Track,
    has_camera,
    inverse,
    pose_of_matrix,
    read_numbers,
    read_poses,
    read_tr,
    to_seconds,
)

USUAL_S = 0.1
"""From scan to scan, where no times are known."""
TR_ARCHIVE = "data_odometry_calib.zip"
"""The archive of KITTI's odometry whose calib.txt have the line Tr."""
FRACTION = r"(?:([._-])(\d+))?"
NAMED_TIME = re.compile(rf"(\d+){FRACTION}")
"""The name of a cloud that is its time, where another sign may stand for the point."""
NAMED_SINCE_1970 = re.compile(rf"(?<!\d)([1-9]\d{{9,}}){FRACTION}")
"""The time in the name of a cloud, such as that of nuScenes: n008…__LIDAR_TOP__1532402927647951."""
PosesOf: TypeAlias = Literal["sensor", "camera"]


def read_folder(
    path: Path,
    poses_file: Path | None,
    beside: Path,
    poses_of: PosesOf | None,
    columns: int | None,
) -> Log:
    """The log in a folder of clouds.

    Args:
        path: The folder, or one with the clouds in ``velodyne``.
        poses_file: A file of poses that the user names.
        beside: Otherwise, that of KITTI's layout.
        poses_of: What the poses are of; None: decided by form and place of the file.
        columns: See `scenegen.clouds.read_cloud`.

    Raises:
        DatasetError: See `scenegen.logs.read.read_log`.
    """
    clouds = path / KITTI_FOLDER
    if not clouds.is_dir():
        clouds = path
    files, source = scans_in(clouds), poses_file or beside
    track = read_poses(source)
    if not files:
        raise DatasetError(f"{clouds}: holds no clouds; expected {', '.join(READERS)} files")
    poses, of_what = track.poses, "sensor"
    if _is_of_camera(path / "calib.txt", source, track, poses_file is not None, poses_of):
        camera, of_what = _camera(path / "calib.txt", source), "camera, moved by Tr,"
        poses = [chained(chained(inverse(camera), pose), camera) for pose in poses]
    times, placed, pairs = _paired(path, files, Track(track.times_s, poses), source)

    read = partial(read_cloud, columns=columns)

    def readers() -> Iterator[Reader]:
        return ((str(file), partial(read, file)) for file in files)

    samples = dict(enumerate(map(read, files[:2])))
    first = samples[0]
    if pairs["scan_times"].startswith("unknown"):  # so the unit of points' times is, too
        samples = {}
    return make_log(
        path,
        times,
        placed,
        readers,
        samples,
        track.times_s,
        about={
            "clouds": f"{len(files)} clouds",
            "fields": first.layout,
            "frame": "frame of the sensor",
            "poses": f"poses of the {of_what} from {source.name}",
        },
        details={"poses_form": track.form, **pairs},
    )


def _paired(
    path: Path, files: Sequence[Path], track: Track, source: Path
) -> tuple[Floats, Sequence[Pose | None], dict[str, str]]:
    """When each cloud began, seconds, its pose, and how both were found, in words. Raises
    DatasetError if nothing says which pose is whose."""
    known, named = _times_beside(path, len(files)), "times.txt"
    if np.isnan(known).all() and track.is_timed:
        known, named = _times_named(files, track.times_s), "the names of the clouds"
    are_known = bool(np.isfinite(known).all())
    in_order = len(files) == len(track.poses)
    if in_order and are_known and track.is_timed:  # clocks may differ, but not in pace
        in_order = bool(np.ptp(known - track.times_s) <= BEYOND_S)
    if not in_order and are_known and track.is_timed:
        poses = [track.at(time) for time in known.tolist()]
        return known, poses, {"scan_times": named, "pairs": f"by time, poses {span(track.times_s)}"}
    if not in_order:
        raise DatasetError(
            f"{files[0].parent}: {len(files)} clouds and {len(track.poses)} poses in {source}; "
            "expected one each; or poses with times, and times.txt or clouds named by theirs, not "
            "by number"
        )
    if track.is_timed:
        known, named = track.times_s, source.name
    elif not are_known:
        known, named = USUAL_S * np.arange(float(len(files))), f"unknown, {USUAL_S:g} s apart"
    return known, track.poses, {"scan_times": named, "pairs": "one pose for each cloud, in order"}


def _times_beside(path: Path, count: int) -> Floats:
    file = path / "times.txt"
    if not file.exists():
        return np.full(count, np.nan)
    times = read_numbers(file)[1].reshape(-1)
    if len(times) != count:
        raise DatasetError(f"{file}: {len(times)} times of {count} clouds")
    if (np.diff(times) < 0).any():
        raise DatasetError(f"{file}: a time is before the one above it")
    return to_seconds(times, f"{file}: times")[0]


def _times_named(files: Sequence[Path], posed_s: Floats) -> Floats:
    """The times in the names of clouds, seconds (n,), of which some are between those of poses; NaN
    where the names only count them, or not all have a time."""
    parts = [
        NAMED_TIME.fullmatch(file.stem) or NAMED_SINCE_1970.search(file.name) for file in files
    ]
    matches = [part for part in parts if part]
    times = np.array([float(f"{part[1]}.{part[3] or 0}") for part in matches])
    count_only = not any(part[3] for part in matches) and (times < MIN_UNIX_S).all()
    if len(matches) < len(files) or count_only:
        return np.full(len(files), np.nan)
    if len({len(part[3] or "") for part in matches if part[2] != "."}) > 1:
        raise DatasetError(
            f"{files[0].parent}: names have fractions of a second of several lengths; expected a "
            "pose for each cloud, or clouds named by their time"
        )
    where = f"{files[0].parent}: the times in the names of clouds"
    return to_seconds(times, where, near_s=posed_s)[0]


def _is_of_camera(
    calibration: Path, source: Path, track: Track, is_named: bool, poses_of: PosesOf | None
) -> bool:
    """Whether the poses in `source` are those of KITTI's camera, not the sensor's. Raises
    DatasetError if that is not known: for matrices in a file that `is_named` by the user, if there
    is a Tr beside the clouds."""
    if poses_of is not None:
        return poses_of == "camera"
    if track.is_timed or not is_named:
        return not track.is_timed
    if has_camera(calibration):
        raise DatasetError(
            f"{source}: has matrices as KITTI's, and {calibration} a Tr; expected --poses-of "
            "camera, as in KITTI's own files, or --poses-of sensor"
        )
    return False


def _camera(calibration: Path, source: Path) -> Pose:
    """Where the sensor is in the frame of KITTI's camera. Raises DatasetError if `calibration` does
    not say so."""
    row = read_tr(calibration)
    if row is None:
        raise DatasetError(
            f"{calibration}: {'has no line Tr' if calibration.exists() else 'no such file'}; "
            f"expected where the sensor is in the frame of the camera, which the poses in {source} "
            f"are of: KITTI's {TR_ARCHIVE} has it; or --poses-of sensor, if they are the sensor's"
        )
    return pose_of_matrix(row, f"{calibration}: Tr")
