"""MCAP recordings (mcap.dev) with ROS 2 messages: scans and voxels as point clouds, maps as voxel
grids, and where the sensor was.

Messages are in CDR (OMG's Common Data Representation, little-endian), where a number begins at a
multiple of its size. Their definitions are ROS's own common interfaces and Foxglove's VoxelGrid,
written here as far as they are used.
"""

import io
import struct
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Sensor
from scenegen.display.exchange.choices import Choices
from scenegen.sample import Sample

RULE = "\n" + 80 * "=" + "\n"
TIME = f"{RULE}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
HEADER = f"{RULE}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{TIME}"
CLOUD = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool "
    "is_bigendian\n"
    "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    f"{RULE}MSG: sensor_msgs/PointField\nstring name\nuint32 offset\nuint8 datatype\nuint32 "
    f"count\n{HEADER}"
)
POSES = (
    f"{RULE}MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion "
    f"orientation\n"
    f"{RULE}MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{RULE}MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
)
POSE = f"std_msgs/Header header\ngeometry_msgs/Pose pose\n{POSES}{HEADER}"
VOXEL_GRID = (
    "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\nuint32 "
    "row_count\n"
    "uint32 column_count\ngeometry_msgs/Vector3 cell_size\nuint32 slice_stride\nuint32 row_stride\n"
    "uint32 cell_stride\nfoxglove_msgs/PackedElementField[] fields\nuint8[] data\n"
    f"{RULE}MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{RULE}MSG: foxglove_msgs/PackedElementField\nstring name\nuint32 offset\nuint8 "
    f"type\n{POSES}{TIME}"
)
SCHEMAS = {
    "sensor_msgs/msg/PointCloud2": CLOUD,
    "geometry_msgs/msg/PoseStamped": POSE,
    "foxglove_msgs/msg/VoxelGrid": VOXEL_GRID,
}
FLOAT32 = 7
"""PointField's number for it."""
UINT8 = 1
"""PackedElementField's number for it."""
FRAME = "world"


class Mcap:
    """``train-000000.mcap`` with the first samples, a second apart, and so on. Topics are
    ``/scan``, the returns; ``/observed``, ``/free`` and ``/occupancy``, centres of voxels; all
    PointCloud2 in the world; ``/map``, a VoxelGrid with those three as fields, 0 or 1; and
    ``/pose``, the body's PoseStamped."""

    together = 100

    def __init__(self, choices: Choices):
        pass

    def names(self, split: str, number: int) -> tuple[str, ...]:
        """The file that begins with a sample."""
        return (f"{split}-{number // self.together:06d}.mcap",)

    def encode(
        self, samples: list[tuple[int, Sample]], grid: GridSpec, lidar: Sensor
    ) -> tuple[bytes, ...]:
        """Its content."""
        from mcap.writer import CompressionType, Writer

        memory = io.BytesIO()
        writer = Writer(memory, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="scenegen")
        clouds, poses, maps = (
            writer.register_schema(name, "ros2msg", text.encode()) for name, text in SCHEMAS.items()
        )
        schemas = dict.fromkeys((*VOXELS, "scan"), clouds) | {"map": maps, "pose": poses}
        topics = {
            name: writer.register_channel(f"/{name}", "cdr", schema)
            for name, schema in schemas.items()
        }
        for number, sample in samples:
            points = {"scan": sample.points(lidar)}
            centres = grid.centres(sample.origin)
            points |= {name: centres[getattr(sample, name)] for name in VOXELS}
            messages = {name: encode_cloud(found, number) for name, found in points.items()}
            messages["map"] = encode_map(
                {name: getattr(sample, name) for name in VOXELS}, sample.origin, grid, number
            )
            messages["pose"] = encode_pose(sample.position, sample.quaternion, number)
            for name, data in messages.items():
                at = number * 10**9
                writer.add_message(
                    topics[name], log_time=at, publish_time=at, data=data, sequence=number
                )
        writer.finish()
        return (memory.getvalue(),)


VOXELS = ("observed", "free", "occupancy")


def encode_cloud(points: NDArray[np.float64], second: int) -> bytes:
    """A PointCloud2 of points (n, 3), float32."""
    out = _Cdr()
    out.header(second)
    out.put("II", 1, len(points))
    out.put("I", 3)
    for n, axis in enumerate("xyz"):
        out.text(axis)
        out.put("IBI", 4 * n, FLOAT32, 1)
    out.put("?II", False, 12, 12 * len(points))
    data = points.astype("<f4").tobytes()
    out.put("I", len(data))
    out.raw(data)
    out.put("?", True)
    return out.content


def encode_pose(
    position: NDArray[np.float64], quaternion: NDArray[np.float64], second: int
) -> bytes:
    """A PoseStamped of a position (3,) and a quaternion w, x, y, z."""
    out = _Cdr()
    out.header(second)
    out.put("7d", *position, *np.roll(quaternion, -1))
    return out.content


def encode_map(
    fields: Mapping[str, NDArray[np.bool_]],
    origin: NDArray[np.float64],
    grid: GridSpec,
    second: int,
) -> bytes:
    """A VoxelGrid of `fields` (X, Y, Z), whose least corner is `origin` (3,) in the world,
    metres."""
    out = _Cdr()
    out.header(second)
    out.put("7d", *origin, 0, 0, 0, 1)
    columns, rows, _ = grid.shape
    out.put("II", rows, columns)
    out.put("3d", *(grid.voxel_m,) * 3)
    stride = len(fields)
    out.put("III", stride * columns * rows, stride * columns, stride)
    out.put("I", stride)
    for n, name in enumerate(fields):
        out.text(name)
        out.put("IB", n, UINT8)
    data = np.stack(list(fields.values()), axis=-1).transpose(2, 1, 0, 3).astype(np.uint8).tobytes()
    out.put("I", len(data))
    out.raw(data)
    return out.content


class _Cdr:
    """A message in the making."""

    def __init__(self) -> None:
        self._parts = bytearray()

    @property
    def content(self) -> bytes:
        """The message with its own head, which says little-endian."""
        return b"\x00\x01\x00\x00" + bytes(self._parts)

    def put(self, kinds: str, *values: float) -> None:
        """Numbers of these kinds, as `struct` calls them, each at a multiple of its size."""
        repeat, kinds = (int(kinds[:-1]), kinds[-1]) if kinds[0].isdigit() else (1, kinds)
        for kind, value in zip(kinds * repeat, values, strict=True):
            size = struct.calcsize(kind)
            self.raw(bytes(-len(self._parts) % size) + struct.pack(f"<{kind}", value))

    def text(self, value: str) -> None:
        """A text, which ends with a zero."""
        content = value.encode() + b"\0"
        self.put("I", len(content))
        self.raw(content)

    def raw(self, content: bytes) -> None:
        """Bytes as they are."""
        self._parts += content

    def header(self, second: int) -> None:
        """A std_msgs/Header in the world's frame."""
        self.put("iI", second, 0)
        self.text(FRAME)
