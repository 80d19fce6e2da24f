"""Recordings as drivers of ROS 2 write them, by mcap's own writer."""

import math

import numpy as np
import pytest

from scenegen.logs.bags import CLOUD, DEFINITIONS, LIVOX, ODOMETRY, TRANSFORMS
from tests.command_line import beside

BEGIN_S = 1_700_000_000.0
PERIOD_S = 0.1
SPEED_MPS = 10.0
"""Along x."""
POINT_TYPES = {"u1": 2, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""Numbers of types in a PointField."""
TEXTS = {
    **DEFINITIONS,
    LIVOX[0]: beside(__file__, "CustomMsg.msg"),
    ODOMETRY: beside(__file__, "Odometry.msg"),
}
"""Definitions of types; that of Livox is from github.com/Livox-SDK/livox_ros_driver2."""


def header(frame, time_s):
    seconds = math.floor(time_s)
    stamp = {"sec": seconds, "nanosec": round((time_s - seconds) * 1e9)}
    return {"stamp": stamp, "frame_id": frame}


def named(names, values):
    """Values by names of one letter."""
    return dict(zip(names, map(float, values), strict=True))


class Bag:
    """Messages of one recording, written by `write`."""

    def __init__(self):
        pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed")
        self.messages = []

    def add(self, topic, time_s, kind, frame, **fields):
        fields["header"] = header(frame, time_s)
        self.messages.append((topic, time_s, kind, fields))

    def cloud(self, time_s, points, frame="lidar", topic="/points", row_step=None, **fields):
        """A PointCloud2 of points (n, 3), with other fields (n,)."""
        columns = dict(zip("xyz", np.asarray(points, "f4").T, strict=True)) | fields
        rows = np.rec.fromarrays(columns.values(), names=list(columns))
        described = [
            {"name": name, "offset": offset, "datatype": POINT_TYPES[kind.str[1:]], "count": 1}
            for name, (kind, offset) in rows.dtype.fields.items()
        ]
        self.add(
            *(topic, time_s, CLOUD, frame),
            height=1,
            width=len(rows),
            fields=described,
            point_step=rows.itemsize,
            row_step=rows.nbytes if row_step is None else row_step,
            data=rows.tobytes(),
        )

    def transform(self, time_s, child, parent, position, turn=(0, 0, 0, 1), topic="/tf"):
        """A transform, turned by x y z w."""
        link = {
            "header": header(parent, time_s),
            "child_frame_id": child,
            "transform": {"translation": named("xyz", position), "rotation": named("xyzw", turn)},
        }
        self.messages.append((topic, time_s, TRANSFORMS, {"transforms": [link]}))

    def odometry(self, time_s, child, parent, position, turn):
        """A message of odometry, turned by x y z w."""
        pose = {"position": named("xyz", position), "orientation": named("xyzw", turn)}
        pose = {"pose": pose, "covariance": [0.0] * 36}
        twist = {"twist": {}, "covariance": [0.0] * 36}
        self.add("/odom", time_s, ODOMETRY, parent, child_frame_id=child, pose=pose, twist=twist)

    def write(self, path):
        """Puts all messages into a .mcap, in the order of their times; its path."""
        from mcap_ros2.writer import Writer

        path = path.with_suffix(".mcap")
        with path.open("wb") as file:
            writer, schemas = Writer(file), {}
            for topic, time_s, kind, message in sorted(self.messages, key=lambda row: row[1]):
                if kind not in schemas:
                    schemas[kind] = writer.register_msgdef(kind, TEXTS[kind])
                when_ns = round(time_s * 1e9)
                writer.write_message(topic, schemas[kind], message, log_time=when_ns)
            writer.finish()
        return path


def sweeps(scans=6, points=200):
    """Scans of a sensor that moves by `SPEED_MPS` among standing points: the stamp, when each point
    is seen after it, where the sensor sees it, and where it is from the sensor as the scan
    begins."""
    rng = np.random.default_rng(0)
    for n in range(scans):
        after = np.sort(rng.uniform(0, 0.995 * PERIOD_S, points))
        after[0], after[-1] = 0, 0.995 * PERIOD_S
        from_start = rng.uniform(2, 8, (points, 3)) * rng.choice([-1, 1], (points, 3))
        seen = from_start - np.outer(after * SPEED_MPS, [1, 0, 0])
        yield BEGIN_S + n * PERIOD_S, after, seen, from_start


def drive(times_of=None, **clouds):
    """A bag of such scans, and where their points are as each begins. `times_of` makes fields of
    the times of points, and of the stamp."""
    bag, truth = Bag(), []
    for stamp, after, seen, from_start in sweeps():
        bag.cloud(stamp, seen, **(times_of(after, stamp) if times_of else {}), **clouds)
        truth.append(from_start)
    return bag, truth


def moving(bag, topic="/tf", child="lidar", parent="map", scans=6):
    """Adds the poses of `drive` to its bag."""
    for n in range(scans + 1):
        place = (SPEED_MPS * PERIOD_S * n, 0, 0)
        bag.transform(BEGIN_S + PERIOD_S * n, child, parent, place, topic=topic)
    return bag
