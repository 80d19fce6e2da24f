"""ROS 2 messages in MCAP files (mcap.dev): their definitions, and how points become one."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats

CLOUD, TRANSFORMS = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
FOLDER = Path(__file__).with_name("definitions")
DEFINITIONS = {
    name: (FOLDER / f"{Path(name).name}.msg").read_text(encoding="utf-8")
    for name in (CLOUD, TRANSFORMS)
}
"""ROS's common interfaces, as far as they are used."""
POINT_TYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""NumPy's names of PointField's types, by their numbers there."""
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
    """Make the fields of a PointCloud2.

    Args:
        points: (n, 3), metres; written as float32.
        header: The message's header.
        more: Further fields of each point, (n,), of the types in `POINT_TYPES`.
    """
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
