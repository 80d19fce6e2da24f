"""Logs of real sensors: KITTI's odometry layout, clouds beside a file of poses, and ROS 2 in
MCAP."""

import io
import itertools
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.parameters import MOST_LENGTH_M
from scenegen.clouds import read_points, scans_in
from scenegen.display.exchange.recordings import CLOUD, POINT_TYPES, TRANSFORMS
from scenegen.errors import DatasetError, printable
from scenegen.files import open_bounded, read_bounded
from scenegen.limits import MOST_HEADER_BYTES, MOST_LOG_BYTES
from scenegen.logs import LogScan
from scenegen.poses import Track, chained, inverse, pose_of_matrix, read_numbers, read_poses

USUAL_S = 0.1
"""From scan to scan, where no times are known."""
ODOMETRY = "nav_msgs/msg/Odometry"
LIVOX = ("livox_ros_driver2/msg/CustomMsg", "livox_interfaces/msg/CustomMsg")
"""Livox's own message, as its two drivers for ROS 2 call it."""
BAG = "metadata.yaml"
"""What every bag of ROS 2 has in its folder."""
LEAST_UNIX_S = 10**9
"""Whole numbers below this (September 2001) in the names of clouds count them, and are no times."""
TIMES = ("t", "time", "timestamp", "time_stamp", "offset_time")
"""What drivers call the time of a point: seconds, or nanoseconds where they are whole numbers."""


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
        return path.suffix == ".mcap"
    return any(one.exists() for one in (path / BAG, path / "poses.txt", _kitti_poses(path)))


def _kitti_poses(sequence: Path) -> Path:
    """Where KITTI's own archives have the poses of a sequence."""
    return sequence.parent.parent / "poses" / f"{sequence.name}.txt"


def read_log(path: Path, *, poses: Path | None = None, topic: str | None = None) -> Log:
    """The log at `path`.

    Args:
        path: An .mcap file with PointCloud2 or Livox's CustomMsg, and /tf or odometry, or the bag
            that holds it; or a folder of clouds: one of KITTI's odometry or SemanticKITTI
            (``velodyne``, ``poses.txt``, ``calib.txt``), or any with `poses`.
        poses: A file of poses, see `read_poses`: one a cloud, in the order of the clouds' names,
            or any number with times, where ``times.txt`` or the clouds' names give theirs, seconds.
        topic: The topic of the clouds, where a file has several.

    Raises:
        DatasetError: There is no log, or it is not as it should be.
    """
    if not path.is_dir():
        if path.suffix == ".mcap":
            return _read_mcap(path, topic)
        raise DatasetError(f"{path}: expected an .mcap file, or a folder of clouds")
    clouds, beside = path / "velodyne", path / "poses.txt"
    if not clouds.is_dir():
        clouds = path
    if not beside.exists():  # as KITTI's own archives have it
        beside = _kitti_poses(path)
    if poses is None and not beside.exists():
        if (path / BAG).exists():
            return _read_mcap(_recording(path), topic)
        raise DatasetError(f"{path}: has no poses.txt; give the file of its poses with --poses")
    files = scans_in(clouds)
    track = read_poses(poses or beside)
    if not files:
        raise DatasetError(f"{clouds}: holds no clouds; expected .bin, .ply, .pcd, .npz or .xyz")
    found: list[Pose | None] = list(track.poses)
    times = track.times_s
    if poses is None:
        times = _times_beside(path, len(files))
        camera = _camera(path / "calib.txt")
        found = [chained(chained(inverse(camera), pose), camera) for pose in track.poses]
    elif len(files) != len(found) and np.isfinite(times).all():
        told = _times_beside(path, len(files))
        if np.isnan(told).all():
            told = _times_named(files)
        if np.isfinite(told).all():
            times, found = told, [track.at(time) for time in told]
    if len(files) != len(found):
        raise DatasetError(
            f"{clouds}: {len(files)} clouds and {len(found)} poses in {poses or beside}; expected "
            "one each; or poses with times, and times.txt or clouds named by theirs, not by number"
        )
    times = np.where(np.isfinite(times), times, USUAL_S * np.arange(len(files)))

    def scans(first: int = 0) -> Iterator[LogScan]:
        rows = zip(files, times, found, strict=True)
        placed = ((file, time, pose) for file, time, pose in rows if pose is not None)
        for file, time, pose in itertools.islice(placed, first, None):
            yield LogScan(float(time), pose, read_points(file))

    return _log(path, times, found, scans)


def _recording(bag: Path) -> Path:
    """The one recording of a bag."""
    files = sorted(bag.glob("*.mcap"))
    if len(files) != 1:
        raise DatasetError(
            f"{bag}: a ROS 2 bag with {len(files)} .mcap files; expected one, as `ros2 bag "
            "convert` makes of several or of a .db3 file"
        )
    return files[0]


def _log(
    path: Path,
    times: Floats,
    found: list[Pose | None],
    scans: Callable[..., Iterator[LogScan]],
) -> Log:
    placed = [n for n, pose in enumerate(found) if pose is not None]
    if not placed:
        raise DatasetError(f"{path}: no pose is of the time of any of its {len(found)} scans")
    poses = tuple(pose for pose in found if pose is not None)
    if (furthest := max(abs(pose.position).max() for pose in poses)) > MOST_LENGTH_M:
        raise DatasetError(
            f"{path}: a pose is beyond {MOST_LENGTH_M:g} m ({furthest:.3g} m); subtract the first "
            "position from all (UTM lies so far out), or give them in metres"
        )
    return Log(times[placed], poses, len(found) - len(placed), scans)


def _times_beside(path: Path, count: int) -> Floats:
    if not (path / "times.txt").exists():
        return np.full(count, np.nan)
    times = read_numbers(path / "times.txt")[1].reshape(-1)
    if len(times) != count:
        raise DatasetError(f"{path / 'times.txt'}: {len(times)} times of {count} clouds")
    return times


def _times_named(files: list[Path]) -> Floats:
    """The times in the names of clouds, seconds (n,); NaN where the names only count them."""
    if all(file.stem.isdecimal() and int(file.stem) < LEAST_UNIX_S for file in files):
        return np.full(len(files), np.nan)
    return np.array([_time_of(file) for file in files])


def _time_of(file: Path) -> float:
    try:
        return float(file.stem)
    except ValueError:
        raise DatasetError(
            f"{file}: expected a pose for each cloud, or clouds named by their time in seconds"
        ) from None


def _camera(path: Path) -> Pose:
    """The line Tr of a KITTI calibration: where the sensor is in the frame of the camera, which the
    poses are of. The camera is the sensor where there is no such line."""
    text = read_bounded(path, MOST_HEADER_BYTES) if path.exists() else b""
    for line in text.decode("latin-1").splitlines():
        if line.startswith("Tr"):
            try:
                row = np.array(line.partition(":")[2].split(), dtype=np.float64).reshape(12)
            except ValueError:
                raise DatasetError(f"{path}: Tr: expected 12 numbers") from None
            return pose_of_matrix(row, f"{path}: Tr")
    return Pose.level((0.0, 0.0, 0.0))


def _read_mcap(path: Path, topic: str | None) -> Log:
    """The log in an MCAP file, which is read twice: for poses, and for clouds."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    def messages(*kinds: str) -> Iterator[tuple[str, str, Any, Any]]:
        """The kind, topic and raw bytes of every message of some kinds, and what decodes it."""
        with open_bounded(path, MOST_LOG_BYTES) as file:
            reader, factory = make_reader(file), DecoderFactory()
            summary = reader.get_summary()
            if summary is None:
                raise ValueError("it has no summary, as if its recording had been cut off")
            channels = summary.channels.values()
            topics = [one.topic for one in channels if summary.schemas[one.schema_id].name in kinds]
            for schema, channel, message in reader.iter_messages(topics) if topics else ():
                if schema is not None and schema.name in kinds:
                    with redirect_stderr(io.StringIO()):  # it prints what it makes of a bad schema
                        decoder = factory.decoder_for(channel.message_encoding, schema)
                    yield schema.name, channel.topic, message.data, decoder

    links, heads = _Links(), defaultdict[str, list[tuple[float, str]]](list)
    with _readable(path):
        for kind, on, data, decode in messages(CLOUD, *LIVOX, TRANSFORMS, ODOMETRY):
            if kind in (CLOUD, *LIVOX):  # its header alone, which stands first
                heads[on].append(_head(data))
            else:
                links.add(kind, decode(data), always=on.endswith("tf_static"))
    if topic is None and len(heads) > 1:
        raise DatasetError(
            f"{path}: has clouds on {', '.join(sorted(heads))[:200]}; name one with --topic"
        )
    topic = topic or next(iter(heads), "")
    if topic not in heads:
        raise DatasetError(
            f"{path}: has no PointCloud2 or CustomMsg{f' on {topic}' if topic else ''}"
        )
    found = [links.pose(frame, time) for time, frame in heads[topic]]
    if not links.known(heads[topic][0][1]):
        raise DatasetError(
            f"{path}: neither /tf nor odometry says where {heads[topic][0][1][:60]!a} is, the "
            f"frame of the clouds on {topic}"
        )

    def scans(first: int = 0) -> Iterator[LogScan]:
        with _readable(path):
            clouds = (row for row in messages(CLOUD, *LIVOX) if row[1] == topic)
            rows = zip(found, heads[topic], clouds, strict=True)
            placed = ((pose, head, one) for pose, head, one in rows if pose is not None)
            for pose, head, (kind, _, data, decode) in itertools.islice(placed, first, None):
                columns = (_livox if kind in LIVOX else _columns)(decode(data))
                points = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
                yield LogScan(head[0], pose, points, columns)

    return _log(path, np.array([time for time, _ in heads[topic]]), found, scans)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Says that a file is none of ROS 2 whatever its reader raises."""
    try:
        yield
    except (DatasetError, FileNotFoundError, ModuleNotFoundError):
        raise
    except Exception as error:  # the library's, struct's, and what else a crafted file brings
        raise DatasetError(
            f"{path}: cannot be read as MCAP of ROS 2: {printable(error)[:200]}"
        ) from None


def _head(data: bytes) -> tuple[float, str]:
    """The time, seconds, and the frame of a message that begins with a header, in CDR."""
    order = "<" if data[1] & 1 else ">"
    seconds, fraction, length = struct.unpack_from(f"{order}iII", data, 4)
    return seconds + 1e-9 * fraction, data[16 : 16 + length].rstrip(b"\0").decode()


class _Links:
    """Where frames are in one another over time."""

    def __init__(self) -> None:
        self._rows = defaultdict[str, dict[float, tuple[str, Pose]]](dict)
        self._always, self._told = set[str](), set[str]()
        self._tracks = dict[str, tuple[str, Track]]()

    def add(self, kind: str, message: Any, *, always: bool) -> None:
        """Take in a message; of a frame that /tf and odometry both speak of, what came first."""
        links = getattr(message, "transforms", None) or [message]
        for one in links:
            child, time = one.child_frame_id.lstrip("/"), _seconds(one.header.stamp)
            if kind == ODOMETRY:
                place, turn = one.pose.pose.position, one.pose.pose.orientation
            else:
                place, turn = one.transform.translation, one.transform.rotation
            pose = Pose(
                np.array([place.x, place.y, place.z]), np.array([turn.w, turn.x, turn.y, turn.z])
            )
            if always:
                self._always.add(child)
            self._rows[child].setdefault(time, (one.header.frame_id.lstrip("/"), pose))

    def known(self, frame: str) -> bool:
        """Whether anything says where a frame is."""
        return frame.lstrip("/") in self._rows

    def pose(self, frame: str, time_s: float) -> Pose | None:
        """The pose of a frame in the one that all others hang from; None where a link of the chain
        is not known at that time."""
        found, name = Pose.level((0.0, 0.0, 0.0)), frame.lstrip("/")
        for _ in range(len(self._rows)):  # a circle of frames ends here, too
            if name not in self._rows:
                break
            parent, track = self._track(name)
            link = track.poses[0] if name in self._always else track.at(time_s)
            if link is None:
                return None
            found, name = chained(link, found), parent
        return found

    def _track(self, name: str) -> tuple[str, Track]:
        if name not in self._tracks:
            times = sorted(self._rows[name])
            rows = [self._rows[name][time] for time in times]
            self._tracks[name] = rows[0][0], Track(np.array(times), [pose for _, pose in rows])
        return self._tracks[name]


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def _livox(cloud: Any) -> dict[str, Floats]:
    """`x`, `y`, `z` and `t` of the points of a CustomMsg, (n,) each."""
    if cloud.point_num != len(cloud.points):
        raise ValueError(f"promises {cloud.point_num} points and holds {len(cloud.points)}")
    rows = [(one.x, one.y, one.z, 1e-9 * one.offset_time) for one in cloud.points]
    return dict(zip("xyzt", np.array(rows).reshape(-1, 4).T, strict=True))


def _columns(cloud: Any) -> dict[str, Floats]:
    """`x`, `y`, `z` and, where it is told, `t` of the points of a PointCloud2, (n,) each."""
    order = ">" if cloud.is_bigendian else "<"
    fields = {one.name: one for one in cloud.fields}
    if missing := [axis for axis in "xyz" if axis not in fields]:
        raise ValueError(f"has no {', '.join(missing)}")
    time = next((name for name in TIMES if name in fields), None)
    names = [*"xyz", *([time] if time else [])]
    kinds = [order + POINT_TYPES[fields[name].datatype] for name in names]
    offsets = [fields[name].offset for name in names]
    dtype = np.dtype(
        {"names": names, "formats": kinds, "offsets": offsets, "itemsize": cloud.point_step}
    )
    if cloud.row_step * cloud.height != len(cloud.data):
        raise ValueError(
            f"promises {cloud.height} rows of {cloud.row_step} bytes and holds {len(cloud.data)}"
        )
    rows = np.frombuffer(cloud.data, np.uint8).reshape(cloud.height, cloud.row_step)
    packed = np.ascontiguousarray(rows[:, : cloud.width * cloud.point_step])
    points = packed.reshape(-1).view(dtype)
    if len(points) != cloud.width * cloud.height:
        raise ValueError(f"promises {cloud.width} × {cloud.height} points and holds {len(points)}")
    found = {name: points[name].astype(np.float64) for name in "xyz"}
    if time and len(points):
        scale = 1e-9 if points[time].dtype.kind in "iu" else 1.0
        since = np.nan_to_num(points[time].astype(np.float64) * scale)
        found["t"] = since - since.min()
    return found
