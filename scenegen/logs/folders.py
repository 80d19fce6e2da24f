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
from scenegen.clouds import KITTI_FOLDER, READERS, check_scan, read_cloud, read_points, scans_in
from scenegen.errors import DatasetError, raised_as
from scenegen.files import read_bounded
from scenegen.limits import MOST_HEADER_BYTES
from scenegen.logs.bags import Points, Reader
from scenegen.logs.log import Log, make_log, span
from scenegen.poses import (
    BEYOND_S,
    MIN_UNIX_S,
    Track,
    inverse,
    pose_of_matrix,
    read_numbers,
    read_poses,
    to_seconds,
)

USUAL_S = 0.1
"""From scan to scan, where no times are known."""
TR_ARCHIVE = "data_odometry_calib.zip"
"""The archive of KITTI's odometry whose calib.txt have the line Tr."""
SECONDS_AND_FRACTION = re.compile(r"(\d+)[_-](\d+)")
"""The name of a cloud that is its time, with the point replaced."""
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

    def read(file: Path) -> Points:
        """Its points; nothing else is known of each."""
        points = read_points(file, columns)
        check_scan(points, np.zeros(3), str(file))
        return points, {}

    def readers() -> Iterator[Reader]:
        return (partial(read, file) for file in files)

    return make_log(
        path,
        times,
        placed,
        readers,
        track.times_s,
        about={
            "clouds": f"{len(files)} clouds",
            "fields": read_cloud(files[0], columns=columns).layout,
            "frame": "frame of the sensor",
            "poses": f"poses of the {of_what} from {source.name}",
            "times": "no times of points",
        },
        details={"poses_form": track.form, **pairs},
        no_point_times=f"{path}: clouds of a folder are read without times of points",
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
    where the names only count them."""
    stems = [file.stem for file in files]
    if all(stem.isdecimal() and int(stem) < MIN_UNIX_S for stem in stems):
        return np.full(len(files), np.nan)
    parts = [SECONDS_AND_FRACTION.fullmatch(stem) for stem in stems]
    expected = "; expected a pose for each cloud, or clouds named by their time"
    with raised_as(DatasetError, f"{files[0].parent}: ", expected):
        if any(parts) and len({part and len(part[2]) for part in parts}) > 1:
            raise ValueError("names have fractions of a second of several lengths")
        # float() would read 1_5 as 15
        digits = [
            f"{part[1]}.{part[2]}" if part else stem.replace("_", " ")
            for part, stem in zip(parts, stems, strict=True)
        ]
        times = np.array(list(map(float, digits)))
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
    row = _read_tr(calibration)
    if row is not None and not np.allclose(row, np.eye(4)[:3].reshape(-1)):
        raise DatasetError(
            f"{source}: has matrices as KITTI's, and {calibration} a Tr; expected --poses-of "
            "camera, as in KITTI's own files, or --poses-of sensor"
        )
    return False


def _camera(calibration: Path, source: Path) -> Pose:
    """Where the sensor is in the frame of KITTI's camera. Raises DatasetError if `calibration` does
    not say so."""
    row = _read_tr(calibration)
    if row is None:
        raise DatasetError(
            f"{calibration}: {'has no line Tr' if calibration.exists() else 'no such file'}; "
            f"expected where the sensor is in the frame of the camera, which the poses in {source} "
            f"are of: KITTI's {TR_ARCHIVE} has it; or --poses-of sensor, if they are the sensor's"
        )
    return pose_of_matrix(row, f"{calibration}: Tr")


def _read_tr(calibration: Path) -> Floats | None:
    """The line Tr of a KITTI calibration (12,); None if there is none."""
    text = read_bounded(calibration, MOST_HEADER_BYTES) if calibration.exists() else b""
    for line in text.decode("latin-1").splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() == "Tr":
            with raised_as(DatasetError, f"{calibration}: Tr: expected 12 numbers: "):
                return np.array(numbers.split(), float).reshape(12)
    return None
