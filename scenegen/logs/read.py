"""Logs of real sensors: recordings of ROS, which `bags` reads, and folders of clouds, which
`folders` reads."""

from functools import partial
from pathlib import Path

import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from scenegen.errors import DatasetError, raised_as
from scenegen.logs.bags import Recording, Surveyed
from scenegen.logs.folders import PosesOf, read_folder
from scenegen.logs.frames import pose_at
from scenegen.logs.log import Log, make_log, period_s
from scenegen.logs.times import find_clock
from scenegen.paths import RECORDINGS, kitti_poses, recordings_in
from scenegen.poses import TUM, Track, read_poses

BAG = "metadata.yaml"
"""What every bag of ROS 2 has in its folder."""


def read_log(
    path: Path,
    *,
    poses: Path | None = None,
    topic: str | None = None,
    poses_of: PosesOf | None = None,
    fixed_frame: str | None = None,
    columns: int | None = None,
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
        poses_of: What the poses of a folder are of: the sensor, or the camera, from which ``Tr`` in
            ``calib.txt`` leads to the sensor. None: the camera for KITTI's own files, else the
            sensor.
        fixed_frame: The frame that poses are in, of those of a recording, see `Links`.
        columns: Of clouds in a folder, see `scenegen.clouds.read_cloud`.

    Raises:
        DatasetError: There is no log, it is not as it should be, or it can be read in two ways.
    """
    if not path.is_dir() and not (path.is_file() and path.suffix in RECORDINGS):
        raise DatasetError(
            f"{path}: no such recording ({', '.join(RECORDINGS)}) or folder of clouds"
        )
    beside = path / "poses.txt"
    if not beside.exists():  # as KITTI's own archives have it
        beside = kitti_poses(path)
    recording = _recording_at(path) if poses or not beside.exists() else None
    if recording is not None:
        if poses_of or columns:
            raise DatasetError(
                f"{path}: a recording has no calib.txt, and names its fields; leave out "
                "--poses-of and --columns"
            )
        if poses and fixed_frame:
            raise DatasetError(f"{path}: poses of a file are in one frame; leave out --fixed-frame")
        return _read_recording(recording, topic, poses, fixed_frame)
    if topic or fixed_frame:
        raise DatasetError(
            f"{path}: a folder of clouds has no topics and frames; leave out --topic and "
            "--fixed-frame"
        )
    if poses is None and not beside.exists():
        raise DatasetError(f"{path}: has no poses.txt; give the file of its poses with --poses")
    return read_folder(path, poses, beside, poses_of, columns)


def _recording_at(path: Path) -> Path | None:
    """The recording in a file, or in a folder: a bag of ROS 2, or the one file in it. None if a
    folder holds none. Raises DatasetError if it holds several."""
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
    path: Path, topic: str | None, poses_file: Path | None, fixed_frame: str | None
) -> Log:
    """The log in a recording, which is read twice: for poses, and for clouds. Its poses are in a
    file, if there is one, or else its own."""
    bag = Recording(path)
    survey = bag.survey(topic, fixed_frame)
    times = survey.stamps_s
    if poses_file is None:
        with raised_as(DatasetError, f"{path}: "):
            poses, posed_s, from_where, form = _by_frames(survey)
    else:
        track = read_poses(poses_file)
        poses, posed_s = _at_stamps(track, times, poses_file), track.times_s
        from_where, form = f"poses of the sensor from {poses_file.name}", track.form
    clock, why = None, ""
    try:
        clock = find_clock(survey.times, period_s(times))
    except ValueError as error:
        why = f"{path}: {error}"
    return make_log(
        path,
        times,
        poses,
        partial(bag.clouds, survey.topic, clock),
        posed_s,
        about={
            "clouds": f"{len(times)} clouds on {survey.topic}",
            "fields": " ".join(survey.fields),
            "frame": f"frame {survey.frame}",
            "poses": from_where,
            "times": f"times from {clock}" if clock else "no times of points",
        },
        details={"poses_form": form, "scan_times": "the stamps of clouds"}
        | ({"point_times": clock.details} if clock else {}),
        no_point_times=why,
    )


def _by_frames(survey: Surveyed) -> tuple[list[Pose | None], Floats, str, str]:
    """The poses of a recording's clouds by its transforms and odometry, over which time they are
    known, and in words where they come from, and by which links. Raises ValueError."""
    chain = survey.links.chain(survey.frame)
    poses = [pose_at(chain, time) for time in survey.stamps_s.tolist()]
    topics = dict.fromkeys(link.topic for link in chain)
    timed = [link.track.times_s for link in chain if link.track.is_timed]
    first = max((times[0] for times in timed), default=np.nan)
    posed_s = np.array([first, min((times[-1] for times in timed), default=np.nan)])
    words = f"poses in {chain[-1].parent} by {' and '.join(topics)}", ", ".join(map(str, chain))
    return poses, posed_s, *words


def _at_stamps(track: Track, times: Floats, source: Path) -> list[Pose | None]:
    """The poses of clouds with stamps at `times`. Raises DatasetError if nothing says which of a
    track without times are theirs."""
    if track.is_timed:
        return [track.at(time) for time in times.tolist()]
    if len(track.poses) != len(times):
        raise DatasetError(
            f"{source}: {len(track.poses)} poses without times, for {len(times)} clouds; expected "
            f"one each, or times: {', '.join(TUM)}"
        )
    return list(track.poses)
