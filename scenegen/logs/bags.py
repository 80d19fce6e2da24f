"""Recordings of ROS, 1 and 2: point clouds, and where their frames were, read without ROS."""

import math
import struct
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.pose import chained
from scenegen.display.exchange.recordings import CLOUD, POINT_TYPES, TRANSFORMS
from scenegen.errors import DatasetError, printable
from scenegen.poses import Track, poses_of

RECORDINGS = (".mcap", ".bag", ".db3")
"""Files of ROS 2, of ROS 1, and of ROS 2's SQLite."""
ODOMETRY = "nav_msgs/msg/Odometry"
FRAMES = (TRANSFORMS, "tf/msg/tfMessage")
"""What is on /tf; the second is of old recordings of ROS 1."""
LIVOX = tuple(
    f"livox_{package}/msg/CustomMsg" for package in ("ros_driver2", "interfaces", "ros_driver")
)
"""Livox's own message, as its drivers for ROS 2 and ROS 1 call it."""
LIVOX_BYTES = 19
"""Bytes of a point in it: its time (uint32, ns), x, y, z (float32, m), and three more."""
TIMES = ("t", "time", "timestamp", "time_stamp", "offset_time")
"""What drivers call the time of a point: seconds, or nanoseconds where they are whole numbers, or
where a scan would take more than `MOST_SCAN_S`; before the cloud's stamp where below 0."""
MOST_SCAN_S = 1e3
Head: TypeAlias = tuple[float, str]
"""The time, seconds, and the frame of a cloud."""
Link: TypeAlias = tuple[str, list[float]]
"""The frame that another hangs from; where that is in it, x y z, and how it is turned, x y z w."""
Points: TypeAlias = tuple[Floats, dict[str, Floats]]
"""The points (n, 3) of a cloud, and what else is known of each, by name, (n,)."""
Reader: TypeAlias = Callable[[], Points]
"""Reads a cloud."""


class Recording:
    """A recording's messages of the kinds that a log is made of. Their types are those that we
    know, not those that the file defines."""

    def __init__(self, path: Path):
        """The recording in a file, or in a bag's folder. Raises ModuleNotFoundError without the
        extra."""
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._path, self._first = path, path.suffix == ".bag"
        store = get_typestore(Stores.ROS1_NOETIC if self._first else Stores.ROS2_HUMBLE)
        for name in FRAMES if self._first else ():
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
        self._reader: Any = Reader1 if self._first else Reader2
        self._decode = store.deserialize_ros1 if self._first else store.deserialize_cdr

    def survey(self, topic: str | None) -> "tuple[str, list[Head], Links]":
        """The topic of the clouds, which must be named where there are several; the heads of its
        clouds; and the frames. Raises DatasetError where there are no clouds."""
        heads, links = defaultdict[str, list[Head]](list), Links()
        for kind, on, data in self._messages(CLOUD, *LIVOX, *FRAMES, ODOMETRY):
            if kind in (CLOUD, *LIVOX):
                heads[on].append(self._head(data)[:2])
            else:
                links.add(on, self._decode(data, kind))
        if topic is None and len(heads) > 1:
            raise DatasetError(
                f"{self._path}: has clouds on {', '.join(sorted(heads))[:200]}; name one with "
                "--topic"
            )
        topic = topic or next(iter(heads), "")
        if topic not in heads:
            raise DatasetError(
                f"{self._path}: has no PointCloud2 or CustomMsg{f' on {topic}' if topic else ''}"
            )
        return topic, heads[topic], links

    def clouds(self, topic: str) -> Iterator[Reader]:
        """What reads each cloud of a topic: its points and, where it is told, `t`, (n,)."""
        for kind, on, data in self._messages(CLOUD, *LIVOX):
            if on == topic:
                yield partial(self._read, kind, data)

    def _read(self, kind: str, data: bytes) -> Points:
        with _readable(self._path):
            if kind == CLOUD:
                return _of_cloud(self._decode(data, CLOUD))
            return _of_livox(data, *self._head(data)[2:], packed=self._first)

    def _messages(self, *kinds: str) -> Iterator[tuple[str, str, bytes]]:
        """The kind, topic and content of every message of some kinds, in the order of recording."""
        with _readable(self._path), self._reader(self._path) as reader:
            chosen = [one for one in reader.connections if one.msgtype in kinds]
            for connection, _, data in reader.messages(chosen) if chosen else ():
                yield connection.msgtype, connection.topic, data

    def _head(self, data: bytes) -> tuple[float, str, str, int]:
        """Of a message that begins with a header: its time, seconds, its frame, its byte order, and
        where the header ends."""
        order = "<" if self._first or data[1] & 1 else ">"  # four bytes say so: of ROS 1, a count
        seconds, fraction, length = struct.unpack_from(f"{order}iII", data, 4)
        frame = data[16 : 16 + length].rstrip(b"\0").decode()
        return seconds + 1e-9 * fraction, frame, order, 16 + length


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Says that a file is no recording whatever its reader raises."""
    try:
        yield
    except (DatasetError, ModuleNotFoundError):
        raise
    except Exception as error:  # the library's, struct's, and what else a crafted file brings
        raise DatasetError(
            f"{path}: cannot be read as a recording of ROS: {printable(error)[:200]}"
        ) from None


class Links:
    """Where frames are in one another over time."""

    def __init__(self) -> None:
        self._rows = defaultdict[str, dict[tuple[bool, str], dict[float, Link]]](dict)
        """What is said of each frame, by whether that is odometry, the topic, and the time."""
        self._tracks = cache(self._track)

    def add(self, topic: str, message: Any) -> None:
        """Take in a message."""
        transforms = getattr(message, "transforms", None)
        for one in [message] if transforms is None else transforms:
            if transforms is None:
                place, turn = one.pose.pose.position, one.pose.pose.orientation
            else:
                place, turn = one.transform.translation, one.transform.rotation
            said = self._rows[one.child_frame_id.lstrip("/")]
            time = math.nan if topic.endswith("tf_static") else _seconds(one.header.stamp)
            numbers = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
            rows = said.setdefault((transforms is None, topic), {})
            rows.setdefault(time, (one.header.frame_id.lstrip("/"), numbers))

    def pose(self, frame: str, time_s: float) -> Pose | None:
        """The pose of a frame in the one that all others hang from; None where a link of the chain
        is not known at that time. Raises ValueError for a link that is no pose, and where nothing
        says where the frame is."""
        found, name = Pose.level((0.0, 0.0, 0.0)), frame.lstrip("/")
        if name not in self._rows:
            raise ValueError(
                f"neither /tf nor odometry says where {frame[:60]!a} is, the frame of its clouds"
            )
        for _ in range(len(self._rows)):  # a circle of frames ends here, too
            if name not in self._rows:
                break
            parent, track = self._tracks(name)
            link = track.poses[0] if np.isnan(track.times_s[0]) else track.at(time_s)
            if link is None:
                return None
            found, name = chained(link, found), parent
        return found

    def _track(self, name: str) -> tuple[str, Track]:
        """The frame that one hangs from, and where it is in that over time, NaN for always. What
        the first topic says holds, and odometry only of frames that no transform speaks of."""
        said = self._rows[name]
        source = min(said, key=itemgetter(0))
        times = sorted(said[source])
        parents, numbers = zip(*map(said[source].__getitem__, times), strict=True)
        poses = poses_of(np.array(numbers), f"{source[1]}: {name[:60]!a}")
        return parents[0], Track(np.array(times), poses)


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def _of_livox(data: bytes, order: str, start: int, *, packed: bool) -> Points:
    """The points of a CustomMsg, (n, 3), and their `t`, (n,). After its header come a time of 8
    bytes, how many points it promises, four bytes, and how many follow; where the message is not
    `packed`, numbers lie at multiples of their size."""
    if not packed:
        start = 4 + -(-(start - 4) // 8) * 8
    promised, count = struct.unpack_from(f"{order}I4xI", data, start + 8)
    step = LIVOX_BYTES if packed else LIVOX_BYTES + 1
    rest = data[start + 20 :]
    held = (len(rest) + step - LIVOX_BYTES) // step
    if not promised == count <= held:
        raise ValueError(f"promises {promised} points and holds {min(count, held)}")
    axes = [(axis, f"{order}f4") for axis in "xyz"]
    dtype = np.dtype([("t", f"{order}u4"), *axes, ("more", f"V{step - 16}")])
    rows = np.frombuffer(rest.ljust(count * step, b"\0"), dtype, count)
    return _points(rows), {"t": 1e-9 * rows["t"]}


def _points(rows: NDArray) -> Floats:
    return np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _of_cloud(cloud: Any) -> Points:
    """The points of a PointCloud2, (n, 3), and, where it is told, their `t`, (n,). Raises
    ValueError where the message does not hold what it promises."""
    fields = {field.name: field for field in cloud.fields}
    if missing := [axis for axis in "xyz" if axis not in fields]:
        raise ValueError(f"has no {', '.join(missing)}")
    time = next((name for name in TIMES if name in fields), None)
    order = ">" if cloud.is_bigendian else "<"
    # NumPy's type of a point: the fields that are read, each with its offset
    layout: Any = {
        name: (order + POINT_TYPES[fields[name].datatype], fields[name].offset)
        for name in ("xyz" if time is None else (*"xyz", time))
    }
    shape, row_bytes, point_bytes = (cloud.height, cloud.width), cloud.row_step, cloud.point_step
    least = np.dtype(layout).itemsize  # points that overlapped would be more than the bytes
    held = len(cloud.data)
    fits = least <= point_bytes and point_bytes * shape[1] <= row_bytes
    if row_bytes * shape[0] != held or not fits:
        raise ValueError(
            f"promises {' × '.join(map(str, shape))} points of {point_bytes} bytes in rows of "
            f"{row_bytes}, and holds {held}; expected points of {least} or more"
        )
    strides = row_bytes, point_bytes
    rows = np.ndarray(shape, layout, cloud.data, strides=strides).reshape(-1)
    points = _points(rows)
    if time is None:
        return points, {}
    return points, {"t": _times(rows[time], points, _seconds(cloud.header.stamp))}


def _times(told: NDArray, points: Floats, stamp_s: float) -> Floats:
    """When points (n, 3) were measured, (n,), seconds after their scan began, from what its driver
    has `told` of each: see `TIMES`. 0 of points that returned nothing."""
    times = told.astype(np.float64)
    times[~np.isfinite(points).all(axis=1)] = np.nan
    first, last = np.fmin.reduce(times, initial=np.nan), np.fmax.reduce(times, initial=np.nan)
    scale = 1e-9 if told.dtype.kind in "iu" or last - first > MOST_SCAN_S else 1.0
    first_s, begin_s = first * scale, 0.0
    if not first_s < 1.0:  # times of a clock: that of the stamp, or another one
        begin_s = stamp_s if abs(first_s - stamp_s) < 1.0 else first_s
    return np.nan_to_num(times * scale - begin_s)
