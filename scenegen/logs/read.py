"""Logs of real sensors: KITTI's odometry layout, clouds beside a file of poses, and recordings of
ROS, which `bags` reads."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.parameters import MOST_LENGTH_M
from lidarsim.pose import chained
from scenegen.clouds import KITTI_FOLDER, READERS, check_scan, read_points, scans_in
from scenegen.errors import DatasetError, raised_as
from scenegen.files import read_bounded
from scenegen.limits import MOST_HEADER_BYTES
from scenegen.logs import LogScan
from scenegen.logs.bags import RECORDINGS, Points, Reader, Recording
from scenegen.poses import inverse, pose_of_matrix, read_numbers, read_poses

USUAL_S = 0.1
"""From scan to scan, where no times are known."""
BAG = "metadata.yaml"
"""What every bag of ROS 2 has in its folder."""
LEAST_UNIX_S = 10**9
"""Whole numbers below this (September 2001) in the names of clouds count them, and are no times."""


@dataclass(frozen=True, eq=False)
class Log:
    """A log whose poses are known, and whose clouds are read one after the other."""

    times_s: Floats
    """(n,): when each scan began, seconds."""
    poses: tuple[Pose, ...]
    """The sensor's at each, as many."""
    without_pose: int
    """Scans that are left out: none of the poses is of their time."""
    scans: Callable[..., Iterator[LogScan]]
    """Reads the n scans, or those from a number on."""


def is_log(path: Path) -> bool:
    """Whether there is a log with poses of its own at `path`, as far as names tell."""
    if not path.is_dir():
        return path.suffix in RECORDINGS
    return any(one.exists() for one in (path / BAG, path / "poses.txt", _kitti_poses(path)))


def _kitti_poses(sequence: Path) -> Path:
    """Where KITTI's own archives have the poses of a sequence."""
    return sequence.parent.parent / "poses" / f"{sequence.name}.txt"


def read_log(
    path: Path,
    *,
    poses: Path | None = None,
    topic: str | None = None,
    columns: int | None = None,
) -> Log:
    """The log at `path`.

    Args:
        path: A recording of ROS (.bag, .mcap, .db3, or a bag's folder) with PointCloud2 or Livox's
            CustomMsg, and /tf or odometry; or a folder of clouds: one of KITTI's odometry or
            SemanticKITTI (``velodyne``, ``poses.txt``, ``calib.txt``), or any with `poses`.
        poses: A file of poses, see `read_poses`: one a cloud, in the order of the clouds' names,
            or any number with times, where ``times.txt`` or the clouds' names give theirs, seconds.
        topic: The topic of the clouds, where a file has several.
        columns: See `scenegen.clouds.read_cloud`.

    Raises:
        DatasetError: There is no log, or it is not as it should be.
    """
    if path.is_file() and path.suffix in RECORDINGS:
        if poses:
            raise DatasetError(f"{path}: a recording holds its own poses; leave out --poses")
        return _read_recording(path, topic)
    if not path.is_dir():
        raise DatasetError(
            f"{path}: no such recording ({', '.join(RECORDINGS)}) or folder of clouds"
        )
    beside = path / "poses.txt"
    if not beside.exists():  # as KITTI's own archives have it
        beside = _kitti_poses(path)
    if poses is None and not beside.exists():
        if (path / BAG).exists():
            return _read_recording(path, topic)
        raise DatasetError(f"{path}: has no poses.txt; give the file of its poses with --poses")
    if topic:
        raise DatasetError(f"{path}: a folder of clouds has no topics; leave out --topic")
    return _read_folder(path, poses, beside, columns)


def _read_folder(path: Path, given: Path | None, beside: Path, columns: int | None) -> Log:
    """The log in a folder of clouds, by the file of poses that is `given`, which are the sensor's,
    or by the one `beside` them, which are those of KITTI's camera."""
    clouds = path / KITTI_FOLDER
    if not clouds.is_dir():
        clouds = path
    files = scans_in(clouds)
    track = read_poses(given or beside)
    if not files:
        raise DatasetError(f"{clouds}: holds no clouds; expected {', '.join(READERS)} files")
    poses: list[Pose | None] = list(track.poses)
    times = track.times_s
    if given is None:
        times = _times_beside(path, len(files))
        camera = _camera(path / "calib.txt")
        poses = [chained(chained(inverse(camera), pose), camera) for pose in track.poses]
    elif len(files) != len(poses) and np.isfinite(times).all():
        of_clouds = _times_beside(path, len(files))
        if np.isnan(of_clouds).all():
            of_clouds = _times_named(files)
        if np.isfinite(of_clouds).all():
            times, poses = of_clouds, [track.at(time) for time in of_clouds]
    if len(files) != len(poses):
        raise DatasetError(
            f"{clouds}: {len(files)} clouds and {len(poses)} poses in {given or beside}; expected "
            "one each; or poses with times, and times.txt or clouds named by theirs, not by number"
        )
    times = np.where(np.isfinite(times), times, USUAL_S * np.arange(len(files)))

    def read(file: Path) -> Points:
        """Its points; nothing else is known of each."""
        points = read_points(file, columns)
        check_scan(points, np.zeros(3), str(file))
        return points, {}

    return _log(path, times, poses, lambda: (partial(read, file) for file in files))


def _log(
    path: Path,
    times: Floats,
    poses: list[Pose | None],
    clouds: Callable[[], Iterator[Reader]],
) -> Log:
    """A log whose `clouds` are as many as its times, seconds, and poses."""
    placed = [n for n, pose in enumerate(poses) if pose is not None]
    if not placed:
        raise DatasetError(f"{path}: no pose is of the time of any of its {len(poses)} scans")
    held = tuple(filter(None, poses))
    if (furthest := max(abs(pose.position).max() for pose in held)) > MOST_LENGTH_M:
        raise DatasetError(
            f"{path}: a pose is beyond {MOST_LENGTH_M:g} m ({furthest:.3g} m); subtract the first "
            "position from all (UTM lies so far out), or give them in metres"
        )

    def scans(first: int = 0) -> Iterator[LogScan]:
        rows = zip(times.tolist(), poses, clouds(), strict=True)
        kept = ((time, pose, read) for time, pose, read in rows if pose is not None)
        for time, pose, read in itertools.islice(kept, first, None):
            yield LogScan(time, pose, *read())

    return Log(times[placed], held, len(poses) - len(placed), scans)


def _times_beside(path: Path, count: int) -> Floats:
    if not (path / "times.txt").exists():
        return np.full(count, np.nan)
    times = read_numbers(path / "times.txt")[1].reshape(-1)
    if len(times) != count:
        raise DatasetError(f"{path / 'times.txt'}: {len(times)} times of {count} clouds")
    if (np.diff(times) < 0).any():
        raise DatasetError(f"{path / 'times.txt'}: a time is before the one above it")
    return times


def _times_named(files: list[Path]) -> Floats:
    """The times in the names of clouds, seconds (n,); NaN where the names only count them."""
    if all(file.stem.isdecimal() and int(file.stem) < LEAST_UNIX_S for file in files):
        return np.full(len(files), np.nan)
    expected = "; expected a pose for each cloud, or clouds named by their time in seconds"
    with raised_as(DatasetError, f"{files[0].parent}: ", expected):
        return np.array([float(file.stem) for file in files])


def _camera(path: Path) -> Pose:
    """The line Tr of a KITTI calibration: where the sensor is in the frame of the camera, which the
    poses are of. The camera is the sensor where there is no such line."""
    text = read_bounded(path, MOST_HEADER_BYTES) if path.exists() else b""
    for line in text.decode("latin-1").splitlines():
        if line.startswith("Tr"):
            with raised_as(DatasetError, f"{path}: Tr: expected 12 numbers: "):
                row = np.array(line.partition(":")[2].split(), float).reshape(12)
            return pose_of_matrix(row, f"{path}: Tr")
    return Pose.level((0.0, 0.0, 0.0))


def _read_recording(path: Path, topic: str | None) -> Log:
    """The log in a recording, which is read twice: for poses, and for clouds."""
    bag = Recording(path)
    topic, heads, links = bag.survey(topic)
    with raised_as(DatasetError, f"{path}: "):
        found = [links.pose(frame, time) for time, frame in heads]
    times = np.array([time for time, _ in heads])
    return _log(path, times, found, partial(bag.clouds, topic))
