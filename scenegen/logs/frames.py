"""Poses of frames in one another over time, from the transforms and odometry of a recording."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from lidarsim import Pose
from lidarsim.parameters import short_repr
from lidarsim.pose import chained
from scenegen.worlds.poses import Track, poses_of

STATIC = "_static"
"""End of the topics of transforms that never change (`/tf_static`)."""
CHANGED = 1e-3
"""Maximum difference between a static transform and the same one sent again: metres, and parts of
a quaternion."""


Source: TypeAlias = tuple[bool, str]
"""Whether it is odometry, and its topic; for transforms, without `STATIC`."""
Parents: TypeAlias = dict[tuple[str, str], dict[float, list[float]]]
"""Poses of one frame from one source: by parent and topic, x y z and quaternion x y z w by time in
seconds. A time of NaN is that of a static transform."""


@dataclass(frozen=True, eq=False)
class Link:
    """The pose of a frame in its parent, over time."""

    parent: str
    child: str
    topic: str
    track: Track
    """The child's poses in the parent; a static transform has one, whose time is NaN."""

    def at(self, time_s: float) -> Pose | None:
        """Return the child's pose in the parent; None if it is not known at that time."""
        return self.track.at(time_s) if self.track.is_timed else self.track.poses[0]

    def __str__(self) -> str:
        return f"{self.child} in {self.parent} by {self.topic}"


class Links:
    """Tree of frames, in which each frame has one parent."""

    def __init__(self, fixed: str | None = None) -> None:
        """Begin an empty tree.

        Args:
            fixed: Name of the frame that poses are in; it also decides between several parents of
                a frame. None: the root of the tree.
        """
        # frames of ROS 1 may be written with a slash in front, those of tf2 are not
        self._fixed = fixed and fixed.lstrip("/")
        self._rows = defaultdict[str, dict[Source, Parents]](dict)

    def add(self, topic: str, message: Any) -> None:
        """Add the poses of a message.

        Args:
            topic: The message's topic.
            message: A TFMessage, or an Odometry.
        """
        transforms = getattr(message, "transforms", None)
        for entry in [message] if transforms is None else transforms:
            if transforms is None:
                place, turn = entry.pose.pose.position, entry.pose.pose.orientation
            else:
                place, turn = entry.transform.translation, entry.transform.rotation
            # /tf_static is sent once, with any time
            time = math.nan if topic.endswith(f"tf{STATIC}") else seconds(entry.header.stamp)
            numbers = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
            source = transforms is None, topic.removesuffix(STATIC)
            links = self._rows[entry.child_frame_id.lstrip("/")].setdefault(source, {})
            rows = links.setdefault((entry.header.frame_id.lstrip("/"), topic), {})
            before = rows.setdefault(time, numbers)
            if math.isnan(time) and not np.allclose(before, numbers, atol=CHANGED):
                rows[math.inf] = numbers  # `_link` refuses it, but only if the frame is needed

    def chain(self, frame: str) -> tuple[Link, ...]:
        """Return the links from a frame up to the fixed frame, the frame's own first.

        Raises:
            ValueError: No message has the frame's pose, a frame has two parents or is its own
                ancestor, a pose is not valid, or the fixed frame is no ancestor.
        """
        links, name = list[Link](), frame.lstrip("/")
        if name == self._fixed:
            raise ValueError(
                f"--fixed-frame {short_repr(name)} is the frame of its clouds; name one above it"
            )
        if name not in self._rows:
            raise ValueError(
                f"neither /tf nor odometry says where {short_repr(frame)} is, the frame of its "
                "clouds; "
                "they speak of "
                f"{', '.join(map(short_repr, sorted(self._rows))) or 'no frame'}; give "
                "the poses of the sensor with --poses, or find them with `scenegen ingest --align`"
            )
        while name in self._rows and name != self._fixed:
            links.append(self._link(name))
            name = links[-1].parent
            if any(link.child == name for link in links):  # else this would never end
                raise ValueError(
                    f"its frame {short_repr(name)} hangs from itself, by {links[-1].topic}"
                )
        if self._fixed not in (None, name):
            raise ValueError(
                f"{short_repr(frame)} does not hang from --fixed-frame "
                f"{short_repr(self._fixed)}, but from "
                f"{', '.join(short_repr(link.parent) for link in links)}"
            )
        return tuple(links)

    def _link(self, name: str) -> Link:
        """Return the link from a frame to its parent, by its best source. Raises ValueError, see
        `chain`."""
        # best is /tf, then other transforms in the order of the recording, then odometry
        source = min(self._rows[name], key=lambda source: (source[0], source[1] != "/tf"))
        links = self._rows[name][source]
        parents = dict.fromkeys(parent for parent, _ in links)
        parent = self._fixed if self._fixed in parents else next(iter(parents))
        if len(parents) > 1 and parent != self._fixed:
            raise ValueError(
                f"{source[1]} says where {short_repr(name)} is in "
                f"{' and in '.join(map(short_repr, parents))}"
                "; expected one parent; name the one to follow with --fixed-frame, or give the "
                "poses of the sensor with --poses"
            )
        topic, rows = next(
            (topic, rows) for (above, topic), rows in links.items() if above == parent
        )
        if math.inf in rows:
            raise ValueError(
                f"{topic} says twice, and not the same, where {short_repr(name)} is in "
                f"{short_repr(parent)}; "
                "expected one transform, which never changes; give the poses with --poses"
            )
        times = sorted(rows)
        # before their filter has begun, drivers of odometry send quaternions of zeros
        first = next((n for n, time in enumerate(times) if any(rows[time][3:])), 0)
        numbers = np.array([rows[time] for time in times[first:]])
        poses = poses_of(numbers, f"{topic}: {short_repr(name)}")
        return Link(parent, name, topic, Track(np.array(times[first:]), poses))


def pose_at(chain: Sequence[Link], time_s: float) -> Pose | None:
    """Return the pose of a frame in the root of its chain.

    Args:
        chain: The frame's links, see `Links.chain`.
        time_s: Time, seconds.

    Returns:
        The pose; None if a link has none at that time.
    """
    pose = Pose.level((0.0, 0.0, 0.0))
    for link in chain:
        link_pose = link.at(time_s)
        if link_pose is None:
            return None
        pose = chained(link_pose, pose)
    return pose


def seconds(stamp: Any) -> float:
    """Return the time of a ROS stamp, seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)
