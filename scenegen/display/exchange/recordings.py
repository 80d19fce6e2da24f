"""Recordings for viewers, a hundred samples a file: MCAP with ROS 2 messages, and Rerun's own."""

import io
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import Sensor
from lidarsim.grid import Floats, GridSpec
from scenegen.display.colours import HEIGHTS, MISSED, SENSOR, colour
from scenegen.display.exchange import Choices
from scenegen.display.exchange.files import Together
from scenegen.display.look import MASKS
from scenegen.sample import Sample

CLOUD, POSE, VOXEL_GRID, TRANSFORMS = (
    "sensor_msgs/msg/PointCloud2",
    "geometry_msgs/msg/PoseStamped",
    "foxglove_msgs/msg/VoxelGrid",
    "tf2_msgs/msg/TFMessage",
)
MESSAGES = Path(__file__).with_name("messages")
DEFINITIONS = {
    name: (MESSAGES / f"{Path(name).name}.msg").read_text(encoding="utf-8")
    for name in (CLOUD, POSE, VOXEL_GRID, TRANSFORMS)
}
"""ROS's common interfaces and Foxglove's VoxelGrid, as far as they are used."""
POINT_TYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""NumPy's names of PointField's types, by their numbers there."""
UINT8 = 1
"""PackedElementField's number for uint8."""
FRAME = "world"


class Mcap(Together):
    """MCAP (mcap.dev) with ROS 2 messages, samples a second apart.

    Topics are ``/scan``, the returns; ``/observed``, ``/free`` and ``/occupancy``, centres of
    voxels; all PointCloud2 in the world; ``/map``, a VoxelGrid with those three as fields, 0 or 1;
    and ``/pose``, the body's PoseStamped.
    """

    suffix = ".mcap"

    def __init__(self, choices: Choices):
        super().__init__(choices)
        import mcap_ros2  # noqa: F401 (where it is missing, nothing is written)

    def encode(self, samples: list[tuple[int, Sample]], grid: GridSpec, lidar: Sensor) -> bytes:
        """The content of a file."""

        def rows() -> Iterator[Row]:
            for number, sample in samples:
                header = {"stamp": {"sec": number}, "frame_id": FRAME}
                centres = grid.centres(sample.origin)
                messages = {"scan": (CLOUD, points_message(sample.points(lidar), header))}
                for name in MASKS:
                    messages[name] = CLOUD, points_message(centres[getattr(sample, name)], header)
                messages["map"] = VOXEL_GRID, _voxels(sample, grid, number)
                pose = _pose(sample.position, sample.quaternion)
                messages["pose"] = POSE, {"header": header, "pose": pose}
                yield number, number * 10**9, messages

        memory = io.BytesIO()
        write_messages(memory, (CLOUD, POSE, VOXEL_GRID), rows())
        return memory.getvalue()


Row = tuple[int, int, Mapping[str, tuple[str, Any]]]
"""A number, a time in nanoseconds, and messages by topic, each with its kind before it."""


def write_messages(file: IO[bytes], kinds: Iterable[str], rows: Iterable[Row]) -> None:
    """Write MCAP with ROS 2 messages of these kinds."""
    from mcap_ros2.writer import Writer

    writer = Writer(file)
    schemas = {name: writer.register_msgdef(name, DEFINITIONS[name]) for name in kinds}
    for number, when_ns, messages in rows:
        for topic, (kind, message) in messages.items():
            writer.write_message(
                f"/{topic}", schemas[kind], message, log_time=when_ns, sequence=number
            )
    writer.finish()


def points_message(points: Floats, header: Any, **more: NDArray[Any]) -> dict[str, Any]:
    """A PointCloud2 of points (n, 3), as float32, with `more` of each, (n,), of the types in
    `POINT_TYPES`."""
    columns = dict(zip("xyz", points.T.astype(np.float32), strict=True), **more)
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


def _pose(position: Floats, quaternion: Any) -> dict[str, Any]:
    """A Pose at a position (3,), turned by a quaternion w, x, y, z."""
    return {
        "position": dict(zip("xyz", position, strict=True)),
        "orientation": dict(zip("wxyz", quaternion, strict=True)),
    }


def _voxels(sample: Sample, grid: GridSpec, second: int) -> dict[str, Any]:
    """A VoxelGrid of the sample's masks: x runs fastest, then y, then z."""
    columns, rows, _ = grid.shape
    stride = len(MASKS)
    cells = np.stack([getattr(sample, name) for name in MASKS], axis=-1).transpose(2, 1, 0, 3)
    return {
        "timestamp": {"sec": second},
        "frame_id": FRAME,
        "pose": _pose(sample.origin, (1, 0, 0, 0)),
        "row_count": rows,
        "column_count": columns,
        "cell_size": dict.fromkeys("xyz", grid.voxel_m),
        "slice_stride": stride * columns * rows,
        "row_stride": stride * columns,
        "cell_stride": stride,
        "fields": [{"name": name, "offset": n, "type": UINT8} for n, name in enumerate(MASKS)],
        "data": cells.astype(np.uint8).tobytes(),
    }


FREE = (120, 190, 230)
"""Rerun's colour of free voxels."""


def rerun() -> Any:
    """Imports Rerun with its usage reporting off.

    It reports unless its user's settings forbid that or it is run by a machine (`CI`). One variable
    makes it report all the same, another lets it send traces.
    """
    os.environ.pop("FORCE_RERUN_ANALYTICS", None)
    os.environ.update(CI="true", TELEMETRY_ENABLED="false")
    import rerun as module

    return module


VIEWS = {"seen": "/scan /observed /sensor", "truth": "/occupancy /sensor"}
"""What Rerun shows side by side at first."""


class Rerun(Together):
    """Rerun's recordings (rerun.io), on the timeline `sample`: ``scan`` and ``sensor``, and
    ``observed``, ``free`` and ``occupancy`` as centres of voxels, half a voxel large, in the world;
    and a blueprint with `VIEWS`."""

    suffix = ".rrd"

    def __init__(self, choices: Choices):
        super().__init__(choices)
        rerun()  # where it is missing, nothing is written

    def encode(self, samples: list[tuple[int, Sample]], grid: GridSpec, lidar: Sensor) -> bytes:
        """The content of a file."""
        library = rerun()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "part.rrd"
            # the library draws an id: Rerun takes files of equal ids for one recording
            with library.RecordingStream("scenegen") as stream:
                stream.save(path)
                views = [
                    library.blueprint.Spatial3DView(name=view, contents=shown.split())
                    for view, shown in VIEWS.items()
                ]
                stream.send_blueprint(library.blueprint.Horizontal(*views))
                stream.log("/", library.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
                for number, sample in samples:
                    stream.set_time("sample", sequence=number)
                    for entity, (points, colours, radius) in _entities(sample, grid, lidar).items():
                        stream.log(entity, library.Points3D(points, colors=colours, radii=radius))
                stream.flush()
                stream.disconnect()
            return path.read_bytes()


def _entities(sample: Sample, grid: GridSpec, lidar: Sensor) -> dict[str, tuple[Any, Any, float]]:
    """Points, colours and radius of what is shown of a sample, by name."""
    centres, half = grid.centres(sample.origin), grid.voxel_m / 2
    shades = (255 * colour(np.linspace(0, 1, grid.shape[2]), HEIGHTS)).astype(np.uint8)
    heights = np.broadcast_to(shades, (*grid.shape, 3))
    found = {
        "scan": (sample.points(lidar), MISSED, half / 4),
        "sensor": (sample.position[None], SENSOR, half),
    }
    for name in MASKS:
        mask = getattr(sample, name)
        found[name] = centres[mask], FREE if name == "free" else heights[mask], half
    return found
