"""ROS messages in files: reads point clouds and poses from recordings of ROS 1 and ROS 2, without
ROS, and writes MCAP files (mcap.dev) with ROS 2 messages."""

import struct
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats
from scenegen.base.errors import DatasetError, printable
from scenegen.logs.frames import Links
from scenegen.worlds.clouds import Cloud, cloud_of
from scenegen.worlds.clouds.columns import CloudTable, used_fields

CLOUD, TRANSFORMS = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
MARKERS = "visualization_msgs/msg/MarkerArray"
FOLDER = Path(__file__).with_name("definitions")
DEFINITIONS = {
    name: (FOLDER / f"{Path(name).name}.msg").read_text(encoding="utf-8")
    for name in (CLOUD, TRANSFORMS, MARKERS)
}
"""Texts of the definitions of ROS messages, by the name of the type."""
POINT_TYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""NumPy's names of PointField's data types, by their number in ROS."""
ODOMETRY = "nav_msgs/msg/Odometry"
FRAMES = (TRANSFORMS, "tf/msg/tfMessage")
"""Types of messages on /tf; old recordings of ROS 1 have the second."""
LIVOX = tuple(
    f"livox_{package}/msg/CustomMsg" for package in ("ros_driver2", "interfaces", "ros_driver")
)
"""Livox's CustomMsg, as its drivers for ROS 2 and ROS 1 name it."""
LIVOX_TIME = "offset_time"
"""The first field of a point in a CustomMsg."""
LIVOX_BYTES = 19
"""Bytes of a point in a CustomMsg: time (uint32, ns), x, y, z (float32, m), and three more."""


Row = tuple[int, int, Mapping[str, tuple[str, Any]]]
"""Number, time in nanoseconds, and messages by topic, each as (type, message)."""


Reader: TypeAlias = tuple[str, Callable[[], Cloud]]
"""The name of a cloud, for errors, and a function that reads it."""


@dataclass(frozen=True, eq=False)
class Contents:
    """The topic of clouds of a recording, without their points but for a few samples."""

    topic: str
    """Topic of the clouds."""
    frame: str
    """Frame of the clouds."""
    stamps_s: Floats
    """(n,): the times of the clouds, seconds."""
    links: Links
    """Poses of frames in one another, over time."""
    samples: dict[int, Cloud]
    """Some of the clouds, spread over the recording, by number."""


class BagReader:
    """Reader of a recording's clouds, transforms and odometry. Messages are decoded by ROS's own
    definitions, not by those in the file, which may be wrong or hostile."""

    def __init__(self, path: Path):
        """Prepare to read a recording; `contents` opens it.

        Args:
            path: A file, or the folder of a bag of ROS 2.

        Raises:
            ModuleNotFoundError: The extra `rosbags` is not installed.
        """
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._path, self._first = path, path.suffix == ".bag"
        store = get_typestore(Stores.ROS1_NOETIC if self._first else Stores.ROS2_HUMBLE)
        # the type store lacks messages of /tf of ROS 1, under either name
        for name in FRAMES if self._first else ():
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
        self._reader: Any = Reader1 if self._first else Reader2
        self._decode = store.deserialize_ros1 if self._first else store.deserialize_cdr

    def contents(self, topic: str | None, fixed_frame: str | None = None) -> Contents:
        """Read all but points, in one pass.

        Args:
            topic: Topic of the clouds. None: the only one.
            fixed_frame: The frame that poses are in, see `Links`.

        Raises:
            DatasetError: There are no clouds, clouds on several topics and no `topic`, or clouds
                of several frames.
        """
        heads, links = defaultdict[str, list[tuple[float, str]]](list), Links(fixed_frame)
        samples = defaultdict[str, dict[int, tuple[str, bytes]]](dict)
        for kind, name, data in self._messages(CLOUD, *LIVOX, *FRAMES, ODOMETRY):
            with _readable(self._path):
                if kind not in (CLOUD, *LIVOX):
                    links.add(name, self._decode(data, kind))
                    continue
                if len(heads[name]).bit_count() <= 1:  # the first, second, third, fifth, ninth …
                    samples[name][len(heads[name])] = kind, data
                heads[name].append(self._head(data)[:2])
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
        # two sensors on one topic cannot be told apart in a map
        frames = sorted({frame for _, frame in heads[topic]})
        if len(frames) > 1:
            raise DatasetError(
                f"{self._path}: the clouds on {topic} are of several frames, {', '.join(frames)}; "
                "expected those of one sensor"
            )
        stamps = np.array([time for time, _ in heads[topic]])
        clouds = {n: self._read(*sample) for n, sample in samples[topic].items()}
        return Contents(topic, frames[0], stamps, links, clouds)

    def clouds(self, topic: str) -> Iterator[Reader]:
        """Yield the name of each cloud of a topic, and a function that reads it."""
        for kind, sender, data in self._messages(CLOUD, *LIVOX):
            if sender == topic:
                name = f"{self._path}: cloud at {self._head(data)[0]:.14g} s"
                yield name, partial(self._read, kind, data)

    def _read(self, kind: str, data: bytes) -> Cloud:
        with _readable(self._path):
            if kind == CLOUD:
                return _of_cloud(self._decode(data, CLOUD))
            return _of_livox(data, *self._head(data)[2:], packed=self._first)

    def _messages(self, *kinds: str) -> Iterator[tuple[str, str, bytes]]:
        """Yield type, topic and bytes of every message of these types, in the order of
        recording."""
        with _readable(self._path), self._reader(self._path) as reader:
            chosen = [entry for entry in reader.connections if entry.msgtype in kinds]
            for connection, _, data in reader.messages(chosen) if chosen else ():
                yield connection.msgtype, connection.topic, data

    def _head(self, data: bytes) -> tuple[float, str, str, int]:
        """Read the header of a message: its time in seconds, its frame, the byte order, and the
        offset of the first byte after the header."""
        # ROS 2 begins with four bytes of CDR, of which the second has the byte order; ROS 1 begins
        # with a sequence number of four bytes, and is always little-endian
        order = "<" if self._first or data[1] & 1 else ">"
        whole, fraction, length = struct.unpack_from(f"{order}iII", data, 4)
        # strings of ROS 2 end with a zero byte
        frame = data[16 : 16 + length].rstrip(b"\0").decode()
        return whole + 1e-9 * fraction, frame, order, 16 + length


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Turn any error of a reader into DatasetError."""
    try:
        yield
    except (DatasetError, ModuleNotFoundError):
        raise
    except Exception as error:  # the reader's own, struct's, and others for a crafted file
        raise DatasetError(
            f"{path}: cannot be read as a recording of ROS: {printable(error)[:200]}"
        ) from None


def _of_livox(data: bytes, order: str, start: int, *, packed: bool) -> Cloud:
    """Read the points of a CustomMsg whose header ends at `start`.

    After the header come a time of 8 bytes, the number of points, four other bytes, and the length
    of the array of points. Unless the message is `packed` (ROS 1), numbers are aligned to their
    size.

    Raises:
        ValueError: The numbers of points differ, or the data ends before the last.
    """
    if not packed:  # CDR aligns after its own four bytes
        start = 4 + -(-(start - 4) // 8) * 8
    promised, count = struct.unpack_from(f"{order}I4xI", data, start + 8)
    # in CDR, the next point's time is aligned to four bytes
    step = LIVOX_BYTES if packed else LIVOX_BYTES + 1
    content = data[start + 20 :]
    complete = (len(content) + step - LIVOX_BYTES) // step
    if not promised == count <= complete:
        raise ValueError(f"promises {promised} points and holds {min(count, complete)}")
    axes = [(axis, f"{order}f4") for axis in "xyz"]
    dtype = np.dtype([(LIVOX_TIME, f"{order}u4"), *axes, ("more", f"V{step - 16}")])
    # the last point may lack its padding
    rows = np.frombuffer(content.ljust(count * step, b"\0"), dtype, count)
    return _of_rows(rows, "offset_time x y z reflectivity tag line")


def _of_rows(rows: NDArray[Any], layout: str) -> Cloud:
    """Make a cloud of a structured array (n,); `layout` names its fields, for people."""
    return cloud_of(
        CloudTable({name: rows[name] for name in used_fields(rows.dtype.names or ())}, layout)
    )


def _of_cloud(cloud: Any) -> Cloud:
    """Read the points of a PointCloud2. Raises ValueError if its data has not the size that its
    fields say."""
    fields = {field.name: field for field in cloud.fields}
    order = ">" if cloud.is_bigendian else "<"
    # NumPy's type of a point: the fields that are read, each with its offset
    layout: Any = {
        name: (order + POINT_TYPES[fields[name].datatype], fields[name].offset)
        for name in used_fields([*fields])
    }
    shape, point_bytes, held = (cloud.height, cloud.width), cloud.point_step, len(cloud.data)
    row_bytes = point_bytes * shape[1]
    # some drivers leave `row_step` at 0: it is read only if rows have gaps
    if row_bytes * shape[0] != held:
        row_bytes = cloud.row_step
    min_bytes = np.dtype(layout).itemsize  # with a smaller step, points would overlap
    fits = min_bytes <= point_bytes and point_bytes * shape[1] <= row_bytes
    if row_bytes * shape[0] != held or not fits:
        raise ValueError(
            f"promises {' × '.join(map(str, shape))} points of {point_bytes} bytes in rows of "
            f"{row_bytes}, and holds {held}; expected points of {min_bytes} or more"
        )
    # by strides, since points and rows may have gaps between them
    strides = row_bytes, point_bytes
    rows = np.ndarray(shape, layout, cloud.data, strides=strides).reshape(-1)
    return _of_rows(rows, " ".join(fields))


def write_messages(file: IO[bytes], rows: Iterable[Row]) -> None:
    """Write a file of MCAP with ROS 2 messages.

    Args:
        file: The open file.
        rows: The messages, in the order of time, of types in `DEFINITIONS`; see `Row`.
    """
    from mcap_ros2.writer import Writer

    writer, schemas = Writer(file), dict[str, Any]()
    for number, when_ns, messages in rows:
        for topic, (kind, message) in messages.items():
            if kind not in schemas:
                schemas[kind] = writer.register_msgdef(kind, DEFINITIONS[kind])
            writer.write_message(
                f"/{topic}", schemas[kind], message, log_time=when_ns, sequence=number
            )
    writer.finish()


def points_message(points: Floats, header: Any, **further: NDArray[Any]) -> dict[str, Any]:
    """Make the fields of a PointCloud2.

    Args:
        points: (n, 3), metres; written as float32.
        header: The message's header.
        further: Further fields of each point, (n,), of the types in `POINT_TYPES`.

    Returns:
        The message's fields by name; points are packed, without gaps.
    """
    # little-endian in the message, whatever this machine has
    columns = dict(zip("xyz", points.T.astype(np.float32), strict=True), **further)
    dtype = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    rows = np.rec.fromarrays([*columns.values()], dtype)
    fields = [
        {"name": name, "offset": at, "datatype": POINT_TYPES.index(kind.str[1:]), "count": 1}
        for name, (kind, at, *_) in dtype.fields.items()  # type: ignore[union-attr]
    ]
    return {
        "header": header,
        "height": 1,
        "width": len(rows),
        "fields": fields,
        "point_step": dtype.itemsize,
        "row_step": rows.nbytes,
        "data": rows.tobytes(),
        "is_dense": True,
    }
