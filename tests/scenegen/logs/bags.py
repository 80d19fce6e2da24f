"""Bags of ROS 2 as drivers write them, by rosbags."""

import numpy as np
import pytest

BEGIN_S = 1_700_000_000.0
PERIOD_S = 0.1
SPEED_MPS = 10.0
"""Along x."""


def ros_types():
    """The messages of ROS 2, by their short names; skips without rosbags."""
    stores = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    return store, {name.rpartition("/")[2]: kind for name, kind in store.types.items()}


def named(names, values):
    """Values by names of one letter."""
    return dict(zip(names, map(float, values), strict=True))


class Bag:
    """Messages of one bag, written by `write`."""

    def __init__(self):
        self.store, self.types = ros_types()
        self.messages = []

    def add(self, topic, time_s, message, **fields):
        """Adds a message of this name."""
        self.messages.append((topic, time_s, self.types[message](**fields)))

    def header(self, frame, time_s):
        seconds = int(np.floor(time_s))
        stamp = self.types["Time"](sec=seconds, nanosec=round((time_s - seconds) * 1e9))
        return self.types["Header"](stamp=stamp, frame_id=frame)

    def cloud(self, time_s, points, frame="lidar", topic="/points", row_step=None, **fields):
        """A PointCloud2 of points (n, 3), with other fields (n,)."""
        columns = dict(zip("xyz", np.asarray(points, "f4").T, strict=True)) | fields
        rows = np.rec.fromarrays(columns.values(), names=list(columns))
        numbers = {"u4": 6, "i4": 5, "f4": 7, "f8": 8, "u1": 2}
        described = [
            self.types["PointField"](
                name=name, offset=offset, datatype=numbers[kind.str[1:]], count=1
            )
            for name, (kind, offset) in rows.dtype.fields.items()
        ]
        self.add(
            *(topic, time_s, "PointCloud2"),
            header=self.header(frame, time_s),
            height=1,
            width=len(rows),
            fields=described,
            is_bigendian=False,
            point_step=rows.itemsize,
            row_step=rows.nbytes if row_step is None else row_step,
            data=np.frombuffer(rows.tobytes(), np.uint8),
            is_dense=True,
        )

    def transform(self, time_s, child, parent, position, turn=(0, 0, 0, 1), topic="/tf"):
        """A transform, turned by x y z w."""
        place = self.types["Vector3"](**named("xyz", position))
        turned = self.types["Quaternion"](**named("xyzw", turn))
        link = self.types["TransformStamped"](
            header=self.header(parent, time_s),
            child_frame_id=child,
            transform=self.types["Transform"](translation=place, rotation=turned),
        )
        self.add(topic, time_s, "TFMessage", transforms=[link])

    def odometry(self, time_s, child, parent, position, turn=(0, 0, 0, 1), topic="/odom"):
        """A message of odometry, turned by x y z w."""
        types, zeros = self.types, np.zeros(36)
        still = types["Vector3"](x=0.0, y=0.0, z=0.0)
        pose = types["Pose"](
            position=types["Point"](**named("xyz", position)),
            orientation=types["Quaternion"](**named("xyzw", turn)),
        )
        twist = types["Twist"](linear=still, angular=still)
        self.add(
            *(topic, time_s, "Odometry"),
            header=self.header(parent, time_s),
            child_frame_id=child,
            pose=types["PoseWithCovariance"](pose=pose, covariance=zeros),
            twist=types["TwistWithCovariance"](twist=twist, covariance=zeros),
        )

    def write(self, path):
        """Puts all messages into a bag's folder, in the order of their times."""
        from rosbags.rosbag2 import Writer

        connections = {}
        with Writer(path, version=9) as writer:
            for topic, time_s, message in sorted(self.messages, key=lambda row: row[1]):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                content = self.store.serialize_cdr(message, kind)
                writer.write(connections[topic], round(time_s * 1e9), content)
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
