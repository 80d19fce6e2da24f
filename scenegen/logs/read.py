"""Reads logs of real sensors: recordings of ROS, by `bags`, and folders of clouds, in the layout of
KITTI's odometry or with a file of poses."""

import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.pose import chained
from scenegen.base.errors import DatasetError, reraise_as
from scenegen.base.paths import RECORDINGS, kitti_poses, recordings_in
from scenegen.logs.bags import BagReader, Contents, Reader
from scenegen.logs.frames import pose_at
from scenegen.logs.log import Log, make_log, span
from scenegen.worlds.clouds import KITTI_FOLDER, READERS, read_cloud, scans_in
from scenegen.worlds.poses import (
    BEYOND_S,
    MIN_UNIX_S,
    TUM,
    Track,
    has_camera,
    inverse,
    pose_of_matrix,
    read_numbers,
    read_poses,
    read_tr,
    to_seconds,
)

BAG = "metadata.yaml"
"""The file that the folder of every bag of ROS 2 has."""
USUAL_S = 0.1
"""Time between scans if their times are not known, seconds."""
TR_ARCHIVE = "data_odometry_calib.zip"
"""The archive of KITTI's odometry whose files calib.txt have a line Tr."""
FRACTION = r"(?:([._-])(\d+))?"
NAMED_TIME = re.compile(rf"(\d+){FRACTION}")
"""Name of a cloud that is its time; `_` or `-` may stand for the decimal point."""
NAMED_SINCE_1970 = re.compile(rf"(?<!\d)([1-9]\d{{9,}}){FRACTION}")
"""Time within the name of a cloud, as of nuScenes: n008…__LIDAR_TOP__1532402927647951."""
ORIGIN, UNPOSED = Pose.level(np.zeros(3)), "no poses"
"""The pose of every scan if none are read, and how that is reported."""
PosesOf: TypeAlias = Literal["sensor", "camera"]


def read_log(
    path: Path,
    *,
    poses: Path | None = None,
    topic: str | None = None,
    poses_of: PosesOf | None = None,
    fixed_frame: str | None = None,
    columns: int | None = None,
    posed: bool = True,
) -> Log:
    """Read the log at `path`.

    Args:
        path: A recording of ROS (.bag, .mcap, .db3, or a folder that holds one) with PointCloud2 or
            Livox's CustomMsg; or a folder of clouds: one of KITTI's odometry or SemanticKITTI
            (``velodyne``, ``poses.txt``, ``calib.txt``), or any with `poses`.
        poses: A file of poses, see `read_poses`: one for each cloud, in the order of the clouds'
            names; or any number with times, if the clouds' stamps, ``times.txt`` or the clouds'
            names give theirs. A recording's own transforms and odometry are then not used.
        topic: The topic of the clouds, if a recording has several.
        poses_of: Whether the poses of a folder are those of the sensor or of the camera; ``Tr`` in
            ``calib.txt`` leads from one to the other. None: the camera for KITTI's own files, else
            the sensor.
        fixed_frame: The frame of a recording that poses are in, see `Links`.
        columns: For a folder of clouds, see `scenegen.worlds.clouds.read_cloud`.
        posed: Whether to read poses. If not, all scans are at the origin, as
            `scenegen.logs.align` takes them.

    Raises:
        DatasetError: There is no log, it is damaged, or it can be read in two ways.
    """
    if not path.is_dir() and not (path.is_file() and path.suffix in RECORDINGS):
        raise DatasetError(
            f"{path}: no such recording ({', '.join(RECORDINGS)}) or folder of clouds"
        )
    if not posed and (poses or poses_of or fixed_frame):
        raise DatasetError(
            f"{path}: --align finds the poses of the sensor; leave out --poses, --poses-of and "
            "--fixed-frame, or --align"
        )
    kitti_file = path / "poses.txt"
    if not kitti_file.exists():  # KITTI's own archives keep poses in another folder
        kitti_file = kitti_poses(path)
    # without --poses, KITTI's layout counts before a recording in the same folder
    recording = _recording_at(path) if poses or not kitti_file.exists() else None
    if recording is not None:
        if poses_of or columns:
            raise DatasetError(
                f"{path}: a recording has no calib.txt, and names its fields; leave out "
                "--poses-of and --columns"
            )
        if poses and fixed_frame:
            raise DatasetError(f"{path}: poses of a file are in one frame; leave out --fixed-frame")
        return _read_recording(recording, topic, poses, fixed_frame, posed)
    if topic or fixed_frame:
        raise DatasetError(
            f"{path}: a folder of clouds has no topics or frames; leave out --topic and "
            "--fixed-frame"
        )
    if posed and poses is None and not kitti_file.exists():
        raise DatasetError(
            f"{path}: has no poses.txt; give the file of its poses with --poses, or find them with "
            "`scenegen ingest --align`"
        )
    return _read_folder(path, poses, kitti_file if posed else None, poses_of, columns)


def _recording_at(path: Path) -> Path | None:
    """Return the path of the recording: `path` itself for a file or a bag of ROS 2, else the one
    recording in the folder; None if there is none. Raises DatasetError if there are several."""
    if not path.is_dir() or (path / BAG).exists():
        return path
    recordings = recordings_in(path)
    if len(recordings) > 1:
        raise DatasetError(
            f"{path}: holds {len(recordings)} recordings and no {BAG} that joins them; name one of "
            "them, or make it with ros2 bag reindex"
        )
    return recordings[0] if recordings else None


def _read_recording(
    path: Path,
    topic: str | None,
    poses_file: Path | None,
    fixed_frame: str | None,
    posed: bool,
) -> Log:
    """Read the log in a recording, with the poses in `poses_file`, or else its own.

    The file is read twice, for poses and then for clouds, so that no cloud has to wait in memory
    for its pose.
    """
    bag = BagReader(path)
    contents = bag.contents(topic, fixed_frame)
    times = contents.stamps_s
    poses = list[Pose | None]([ORIGIN] * len(times))
    posed_s, source, form = times, UNPOSED, "none"
    if posed and poses_file is None:
        with reraise_as(DatasetError, f"{path}: "):
            poses, posed_s, source, form = _by_frames(contents)
    elif poses_file is not None:
        track = read_poses(poses_file)
        poses, posed_s = _at_stamps(track, times, poses_file), track.times_s
        source, form = f"poses of the sensor from {poses_file.name}", track.form
    return make_log(
        path,
        times,
        poses,
        partial(bag.clouds, contents.topic),
        contents.samples,
        posed_s,
        about={
            "clouds": f"{len(times)} clouds on {contents.topic}",
            "fields": contents.samples[0].layout,
            "frame": f"frame {contents.frame}",
            "poses": source,
        },
        details={"poses_form": form, "scan_times": "the stamps of clouds"},
    )


def _by_frames(contents: Contents) -> tuple[list[Pose | None], Floats, str, str]:
    """Return the poses of a recording's clouds by its transforms and odometry, the first and last
    time at which they are known, and for people their source and their links.

    Raises:
        ValueError: See `Links.chain`.
    """
    chain = contents.links.chain(contents.frame)
    poses = [pose_at(chain, time) for time in contents.stamps_s.tolist()]
    topics = dict.fromkeys(link.topic for link in chain)
    timed = [link.track.times_s for link in chain if link.track.is_timed]
    # the chain is known only while all of its links are
    first = max((times[0] for times in timed), default=np.nan)
    posed_s = np.array([first, min((times[-1] for times in timed), default=np.nan)])
    words = f"poses in {chain[-1].parent} by {' and '.join(topics)}", ", ".join(map(str, chain))
    return poses, posed_s, *words


def _at_stamps(track: Track, times: Floats, source: Path) -> list[Pose | None]:
    """Return the poses of clouds with stamps at `times`. Raises DatasetError if the track has no
    times, and not one pose for each cloud."""
    if track.is_timed:
        return [track.at(time) for time in times.tolist()]
    if len(track.poses) != len(times):
        raise DatasetError(
            f"{source}: {len(track.poses)} poses without times, for {len(times)} clouds; expected "
            f"one each, or times: {', '.join(TUM)}"
        )
    return list(track.poses)


def _read_folder(
    path: Path,
    poses_file: Path | None,
    kitti_file: Path | None,
    poses_of: PosesOf | None,
    columns: int | None,
) -> Log:
    """Read the log in a folder of clouds.

    Args:
        path: The folder, or one with the clouds in ``velodyne``.
        poses_file: A file of poses that the user names.
        kitti_file: The file of KITTI's layout, used if there is no `poses_file`. None: poses are
            not read.
        poses_of: The sensor or the camera; None: decided by form and place of the file.
        columns: See `scenegen.worlds.clouds.read_cloud`.

    Raises:
        DatasetError: See `read_log`.
    """
    clouds = path / KITTI_FOLDER
    if not clouds.is_dir():
        clouds = path
    files, source = scans_in(clouds), poses_file or kitti_file
    track = Track(np.full(len(files), np.nan), [ORIGIN] * len(files), "none")
    if source:
        track = read_poses(source)
    if not files:
        raise DatasetError(f"{clouds}: holds no clouds; expected {', '.join(READERS)} files")
    poses, poses_owner = track.poses, "sensor"
    if source and _is_of_camera(
        path / "calib.txt", source, track, poses_file is not None, poses_of
    ):
        camera, poses_owner = _camera(path / "calib.txt", source), "camera, moved by Tr,"
        # from the camera's frame to the sensor's, on both sides: in the world, and on the vehicle
        poses = [chained(chained(inverse(camera), pose), camera) for pose in poses]
    times, placed, pairs = _paired(path, files, Track(track.times_s, poses), source)

    read = partial(read_cloud, columns=columns)

    def readers() -> Iterator[Reader]:
        return ((str(file), partial(read, file)) for file in files)

    # two clouds show the unit of the times of points
    samples = dict(enumerate(map(read, files[:2])))
    first = samples[0]
    if pairs["scan_times"].startswith("unknown"):  # then no unit fits the times of points
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
            "poses": f"poses of the {poses_owner} from {source.name}" if source else UNPOSED,
        },
        details={"poses_form": track.form, **pairs},
    )


def _paired(
    path: Path, files: Sequence[Path], track: Track, source: Path | None
) -> tuple[Floats, Sequence[Pose | None], dict[str, str]]:
    """Return when each cloud began, seconds, its pose, and for people how both were found. Raises
    DatasetError if poses and clouds cannot be paired."""
    times, source_name = _times_beside(path, len(files)), "times.txt"
    if np.isnan(times).all() and (track.is_timed or source is None):
        times, source_name = _times_named(files, track.times_s), "the names of the clouds"
    are_known = bool(np.isfinite(times).all())
    in_order = len(files) == len(track.poses)
    if in_order and are_known and track.is_timed:  # clocks may differ, but not in their rate
        in_order = bool(np.ptp(times - track.times_s) <= BEYOND_S)
    if not in_order and are_known and track.is_timed:
        poses = [track.at(time) for time in times.tolist()]
        return (
            times,
            poses,
            {"scan_times": source_name, "pairs": f"by time, poses {span(track.times_s)}"},
        )
    if not in_order:
        raise DatasetError(
            f"{files[0].parent}: {len(files)} clouds and {len(track.poses)} poses in {source}; "
            "expected one each; or poses with times, and times.txt or clouds named by theirs, not "
            "by number"
        )
    if track.is_timed:
        times, source_name = track.times_s, str(source and source.name)
    elif not are_known:
        times, source_name = USUAL_S * np.arange(float(len(files))), f"unknown, {USUAL_S:g} s apart"
    return (
        times,
        track.poses,
        {"scan_times": source_name, "pairs": "one pose for each cloud, in order"},
    )


def _times_beside(path: Path, count: int) -> Floats:
    """Read ``times.txt``, seconds (count,); NaN if there is none."""
    file = path / "times.txt"
    if not file.exists():
        return np.full(count, np.nan)
    times = read_numbers(file)[1].reshape(-1)
    if len(times) != count:
        raise DatasetError(f"{file}: {len(times)} times of {count} clouds")
    if (np.diff(times) < 0).any():  # a wrong column, or clouds of several logs
        raise DatasetError(f"{file}: a time is before the one above it")
    return to_seconds(times, f"{file}: times")[0]


def _times_named(files: Sequence[Path], posed_s: Floats) -> Floats:
    """Read the times in the names of clouds, seconds (n,); NaN if names are only numbers, or not
    all have a time. The unit is that which brings some between the times of poses."""
    parts = [
        NAMED_TIME.fullmatch(file.stem) or NAMED_SINCE_1970.search(file.name) for file in files
    ]
    matches = [part for part in parts if part]
    times = np.array([float(f"{part[1]}.{part[3] or 0}") for part in matches])
    # 000000, 000001 … are numbers, but 1532402927647951 is a time
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
    """Whether the poses in `source` are those of KITTI's camera, not the sensor's.

    Raises:
        DatasetError: Both are possible: the user named the file (`is_named`), it has matrices, and
            there is a Tr beside the clouds.
    """
    if poses_of is not None:
        return poses_of == "camera"
    if track.is_timed or not is_named:
        return not track.is_timed
    if has_camera(calibration):
        raise DatasetError(
            f"{source}: has matrices like KITTI's, and {calibration} a Tr; expected --poses-of "
            "camera, as in KITTI's own files, or --poses-of sensor"
        )
    return False


def _camera(calibration: Path, source: Path) -> Pose:
    """Return the sensor's pose in the frame of KITTI's camera. Raises DatasetError if `calibration`
    has no Tr."""
    row = read_tr(calibration)
    if row is None:
        raise DatasetError(
            f"{calibration}: {'has no line Tr' if calibration.exists() else 'no such file'}; "
            f"expected the sensor's pose in the camera, whose poses {source} has: take it from "
            f"KITTI's {TR_ARCHIVE}; or --poses-of sensor, if the poses are the sensor's"
        )
    return pose_of_matrix(row, f"{calibration}: Tr")
