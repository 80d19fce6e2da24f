"""Recordings of ROS, 1 and 2: point clouds, and where their frames were, read without ROS."""

import struct
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats
from scenegen.clouds import check_scan
from scenegen.errors import DatasetError, printable
from scenegen.logs.frames import Links, seconds
from scenegen.logs.messages import CLOUD, POINT_TYPES, TRANSFORMS
from scenegen.logs.times import PointClock, RawTimes, time_fields

ODOMETRY = "nav_msgs/msg/Odometry"
FRAMES = (TRANSFORMS, "tf/msg/tfMessage")
"""What is on /tf; the second is of old recordings of ROS 1."""
LIVOX = tuple(
    f"livox_{package}/msg/CustomMsg" for package in ("ros_driver2", "interfaces", "ros_driver")
)
"""Livox's own message, as its drivers for ROS 2 and ROS 1 call it."""
LIVOX_TIME = "offset_time"
"""Its points' first field."""
LIVOX_BYTES = 19
"""Bytes of a point in it: its time (uint32, ns), x, y, z (float32, m), and three more."""


@dataclass(frozen=True, eq=False)
class RawCloud:
    """One cloud."""

    points: Floats
    """(n, 3), metres."""
    fields: tuple[str, ...]
    """The names of all fields of its points."""
    times: RawTimes


Points: TypeAlias = tuple[Floats, dict[str, Floats]]
"""The points (n, 3) of a cloud, and what else is known of each, by name, (n,)."""
Reader: TypeAlias = Callable[[], Points]
"""Reads a cloud."""


@dataclass(frozen=True, eq=False)
class Surveyed:
    """What a recording holds."""

    topic: str
    """That of the clouds."""
    frame: str
    """That of the clouds."""
    stamps_s: Floats
    """(n,): the times of the clouds, seconds."""
    links: Links
    fields: tuple[str, ...]
    """The names of the fields of its points."""
    times: list[RawTimes]
    """Of some clouds, spread over the recording."""


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

    def survey(self, topic: str | None, fixed_frame: str | None = None) -> Surveyed:
        """Read everything but points.

        Args:
            topic: That of the clouds, which must be named if there are several.
            fixed_frame: The frame that poses are in, see `Links`.

        Raises:
            DatasetError: There are no clouds, or those of several topics or frames.
        """
        heads, links = defaultdict[str, list[tuple[float, str]]](list), Links(fixed_frame)
        samples = defaultdict[str, list[tuple[str, bytes]]](list)
        for kind, on, data in self._messages(CLOUD, *LIVOX, *FRAMES, ODOMETRY):
            if kind in (CLOUD, *LIVOX):
                if len(heads[on]).bit_count() <= 1:  # the first, second, third, fifth, ninth …
                    samples[on].append((kind, data))
                with _readable(self._path):
                    heads[on].append(self._head(data)[:2])
            else:
                with _readable(self._path):
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
        frames = sorted({frame for _, frame in heads[topic]})
        if len(frames) > 1:
            raise DatasetError(
                f"{self._path}: the clouds on {topic} are of several frames, {', '.join(frames)}; "
                "expected those of one sensor"
            )
        clouds = [self._read(*sample) for sample in samples[topic]]
        stamps, times = np.array([time for time, _ in heads[topic]]), [c.times for c in clouds]
        return Surveyed(topic, frames[0], stamps, links, clouds[0].fields, times)

    def clouds(self, topic: str, clock: PointClock | None) -> Iterator[Reader]:
        """What reads each cloud of a topic: its points and, if a `clock` reads times, `t`, (n,)."""
        for kind, on, data in self._messages(CLOUD, *LIVOX):
            if on == topic:
                yield partial(self._read_points, kind, data, clock)

    def _read_points(self, kind: str, data: bytes, clock: PointClock | None) -> Points:
        cloud = self._read(kind, data)
        where = f"{self._path}: cloud at {cloud.times.stamp_s:.14g} s"
        check_scan(cloud.points, np.zeros(3), where)
        times_s = clock.seconds(cloud.times) if clock else None
        return cloud.points, {} if times_s is None else {"t": times_s}

    def _read(self, kind: str, data: bytes) -> RawCloud:
        with _readable(self._path):
            if kind == CLOUD:
                return _of_cloud(self._decode(data, CLOUD))
            stamp_s, _, order, start = self._head(data)
            return _of_livox(data, order, start, stamp_s, packed=self._first)

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


def _of_livox(data: bytes, order: str, start: int, stamp_s: float, *, packed: bool) -> RawCloud:
    """The points of a CustomMsg. After its header come a time of 8 bytes, how many points it
    promises, four bytes, and how many follow; where the message is not `packed`, numbers lie at
    multiples of their size."""
    if not packed:
        start = 4 + -(-(start - 4) // 8) * 8
    promised, count = struct.unpack_from(f"{order}I4xI", data, start + 8)
    step = LIVOX_BYTES if packed else LIVOX_BYTES + 1
    rest = data[start + 20 :]
    held = (len(rest) + step - LIVOX_BYTES) // step
    if not promised == count <= held:
        raise ValueError(f"promises {promised} points and holds {min(count, held)}")
    axes = [(axis, f"{order}f4") for axis in "xyz"]
    dtype = np.dtype([(LIVOX_TIME, f"{order}u4"), *axes, ("more", f"V{step - 16}")])
    rows = np.frombuffer(rest.ljust(count * step, b"\0"), dtype, count)
    return _raw_cloud(rows, (LIVOX_TIME, *"xyz", "reflectivity", "tag", "line"), stamp_s)


def _raw_cloud(rows: NDArray, fields: tuple[str, ...], stamp_s: float) -> RawCloud:
    """The cloud of `rows` (n,), a structured array with x, y, z and the fields of times among all
    `fields`."""
    points = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)
    returned = np.asarray(np.isfinite(points).all(axis=1) & points.any(axis=1))
    times = {name: rows[name] for name in time_fields(rows.dtype.names or ())}
    return RawCloud(points, fields, RawTimes(times, returned, stamp_s))


def _of_cloud(cloud: Any) -> RawCloud:
    """The points of a PointCloud2. Raises ValueError if the message does not hold what it
    promises."""
    fields = {field.name: field for field in cloud.fields}
    if missing := [axis for axis in "xyz" if axis not in fields]:
        raise ValueError(f"has no {', '.join(missing)}")
    order = ">" if cloud.is_bigendian else "<"
    # NumPy's type of a point: the fields that are read, each with its offset
    layout: Any = {
        name: (order + POINT_TYPES[fields[name].datatype], fields[name].offset)
        for name in (*"xyz", *time_fields(list(fields)))
    }
    shape, point_bytes, held = (cloud.height, cloud.width), cloud.point_step, len(cloud.data)
    row_bytes = point_bytes * shape[1]
    if row_bytes * shape[0] != held:  # rows have gaps; else drivers may leave out how long one is
        row_bytes = cloud.row_step
    least = np.dtype(layout).itemsize  # points that overlapped would be more than the bytes
    fits = least <= point_bytes and point_bytes * shape[1] <= row_bytes
    if row_bytes * shape[0] != held or not fits:
        raise ValueError(
            f"promises {' × '.join(map(str, shape))} points of {point_bytes} bytes in rows of "
            f"{row_bytes}, and holds {held}; expected points of {least} or more"
        )
    strides = row_bytes, point_bytes
    rows = np.ndarray(shape, layout, cloud.data, strides=strides).reshape(-1)
    return _raw_cloud(rows, tuple(fields), seconds(cloud.header.stamp))
