"""Where frames are in one another over time, by the transforms and the odometry of a recording."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from lidarsim import Pose
from lidarsim.pose import chained
from scenegen.base.errors import short
from scenegen.worlds.poses import Track, poses_of

STATIC = "_static"
"""How topics of transforms end that hold for ever."""
CHANGED = 1e-3
"""By how much numbers of a transform that holds for ever may differ when it is sent again."""


Source: TypeAlias = tuple[bool, str]
"""Whether it is odometry, and its topic; of transforms, without `STATIC`."""
Parents: TypeAlias = dict[tuple[str, str], dict[float, list[float]]]
"""What one source says of a frame: by parent and topic, its x y z and x y z w there at each time,
NaN for ever."""


@dataclass(frozen=True, eq=False)
class Link:
    """Where a frame is in another."""

    parent: str
    child: str
    topic: str
    track: Track
    """The poses over time; of a transform that holds for ever, its time is NaN."""

    def at(self, time_s: float) -> Pose | None:
        """The child's pose in the parent; None if it is not known at that time."""
        return self.track.at(time_s) if self.track.is_timed else self.track.poses[0]

    def __str__(self) -> str:
        return f"{self.child} in {self.parent} by {self.topic}"


class Links:
    """Tree of frames. A frame hangs from one parent."""

    def __init__(self, fixed: str | None = None) -> None:
        """Poses are in the frame `fixed`, and where a frame has several parents, this one counts;
        None: the frame from which all others hang."""
        self._fixed = fixed and fixed.lstrip("/")
        self._rows = defaultdict[str, dict[Source, Parents]](dict)

    def add(self, topic: str, message: Any) -> None:
        """Take in a message with transforms, or of odometry."""
        transforms = getattr(message, "transforms", None)
        for entry in [message] if transforms is None else transforms:
            if transforms is None:
                place, turn = entry.pose.pose.position, entry.pose.pose.orientation
            else:
                place, turn = entry.transform.translation, entry.transform.rotation
            time = math.nan if topic.endswith(f"tf{STATIC}") else seconds(entry.header.stamp)
            numbers = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
            source = transforms is None, topic.removesuffix(STATIC)
            links = self._rows[entry.child_frame_id.lstrip("/")].setdefault(source, {})
            rows = links.setdefault((entry.header.frame_id.lstrip("/"), topic), {})
            before = rows.setdefault(time, numbers)
            if math.isnan(time) and not np.allclose(before, numbers, atol=CHANGED):
                rows[math.inf] = numbers  # refused, if the frame is needed

    def chain(self, frame: str) -> tuple[Link, ...]:
        """The links from a frame upwards, the first its own. Raises ValueError if nothing says
        where it is, if a frame has two parents or hangs from itself, and for a link that is no
        pose."""
        links, name = list[Link](), frame.lstrip("/")
        if name == self._fixed:
            raise ValueError(
                f"--fixed-frame {short(name)} is the frame of its clouds; name one above it"
            )
        if name not in self._rows:
            raise ValueError(
                f"neither /tf nor odometry says where {short(frame)} is, the frame of its clouds; "
                f"they speak of {', '.join(map(short, sorted(self._rows))) or 'no frame'}; give "
                "the poses of the sensor with --poses"
            )
        while name in self._rows and name != self._fixed:
            links.append(self._link(name))
            name = links[-1].parent
            if any(link.child == name for link in links):
                raise ValueError(f"its frame {short(name)} hangs from itself, by {links[-1].topic}")
        if self._fixed not in (None, name):
            raise ValueError(
                f"{short(frame)} does not hang from --fixed-frame {short(self._fixed)}, but from "
                f"{', '.join(short(link.parent) for link in links)}"
            )
        return tuple(links)

    def _link(self, name: str) -> Link:
        """What a frame hangs from, by the first of its sources. Raises ValueError as `chain`."""
        # /tf, other transforms as they come in the recording, odometry
        source = min(self._rows[name], key=lambda source: (source[0], source[1] != "/tf"))
        links = self._rows[name][source]
        parents = dict.fromkeys(parent for parent, _ in links)
        parent = self._fixed if self._fixed in parents else next(iter(parents))
        if len(parents) > 1 and parent != self._fixed:
            raise ValueError(
                f"{source[1]} says where {short(name)} is in {' and in '.join(map(short, parents))}"
                "; expected one parent; name the one to follow with --fixed-frame, or give the "
                "poses of the sensor with --poses"
            )
        topic, rows = next(
            (topic, rows) for (above, topic), rows in links.items() if above == parent
        )
        if math.inf in rows:
            raise ValueError(
                f"{topic} says twice, and not the same, where {short(name)} is in {short(parent)}; "
                "expected one transform that holds for ever; give --poses"
            )
        times = sorted(rows)
        # before their filter has begun, drivers of odometry send quaternions of zeros
        first = next((n for n, time in enumerate(times) if any(rows[time][3:])), 0)
        numbers = np.array([rows[time] for time in times[first:]])
        poses = poses_of(numbers, f"{topic}: {short(name)}")
        return Link(parent, name, topic, Track(np.array(times[first:]), poses))


def pose_at(chain: Sequence[Link], time_s: float) -> Pose | None:
    """The pose of a frame in the one in which its chain ends; None if a link is not known then."""
    pose = Pose.level((0.0, 0.0, 0.0))
    for link in chain:
        here = link.at(time_s)
        if here is None:
            return None
        pose = chained(here, pose)
    return pose


def seconds(stamp: Any) -> float:
    """The time of a stamp of ROS."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)
