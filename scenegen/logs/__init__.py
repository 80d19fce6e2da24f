"""Logs: the scans of one drive or flight, with the pose of the sensor at each.

`record` flies through a world, scans it, and puts the log on disk. `read` reads logs, also of real
sensors, and `fuse` makes maps of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from lidarsim.parameters import MIN_RETURN_M, Checked, check, number
from scenegen.base.limits import MOST_PLACE_VOXELS

if TYPE_CHECKING:  # commands take their options from here, and none of these
    from numpy.typing import NDArray

    from lidarsim import Pose
    from lidarsim.grid import Floats


@dataclass(frozen=True, eq=False)
class LogScan:
    """One scan of a log."""

    time_s: float
    """When it began, seconds."""
    pose: "Pose"
    """The sensor's in the world at that moment."""
    points: "Floats"
    """(N, 3): returns in the sensor's frame, metres; not finite where nothing returned."""
    more: "Mapping[str, NDArray]" = field(default_factory=dict)
    """What else is known of each return, (N,): `intensity`; `ring`, the number of its beam; and
    `t`, when its ray was cast, seconds after `time_s`."""


@dataclass(frozen=True, kw_only=True)
class Cruise(Checked):
    """How a sensor flies while it records a log."""

    length_m: float = number(100.0, above=0, most=1e5)
    """Length of the flight, metres."""
    speed_mps: float = number(2.0, least=0.1, most=50)
    """Speed, metres a second; it is less round corners."""
    acceleration_mps2: float = number(4.0, least=0.1, most=100)
    """The most that it speeds up or slows down, and the most that a bend pulls, metres a second
    squared; together twice that at most."""
    yaw_rate_deg_s: float = number(60.0, above=0, most=360)
    """The most that the body turns, degrees a second. It looks along the flight as far as this lets
    it."""


@dataclass(frozen=True, kw_only=True)
class Fusing:
    """How a log becomes maps."""

    voxel_m: float = number(0.2, least=0.01, most=10)
    """Edge of a map's voxel, metres."""
    reach_m: float = number(30.0, above=0, most=1000)
    """How far rays are followed, metres: a return beyond clears the voxels up to here and marks
    none."""
    rise_m: float = number(10.0, above=0, most=1000)
    """How far the map goes above and below the sensor, metres."""
    least_m: float = number(MIN_RETURN_M, least=0, most=100)
    """Returns nearer than this are the sensor's carrier, and left out, metres."""
    moved_share: float = number(0.1, least=0, below=1)
    """The least share of the scans that say something of a voxel which must have a return in it:
    where fewer have, what returned has moved on, and the voxel is free."""
    every: int = number(10, least=1, most=10**6)
    """Every so many scans, one is kept as an observation."""
    deskew: bool = False
    """Whether points are moved to where their rays met something: by the time of each, along the
    way to the next scan's pose. For raw scans of a sensor in motion."""

    def __post_init__(self) -> None:
        check(self)
        wide, high = 2 * self.reach_m / self.voxel_m + 8, 2 * self.rise_m / self.voxel_m + 8
        if wide * wide * high > MOST_PLACE_VOXELS:
            raise ValueError(
                f"reach {self.reach_m:g} m, rise {self.rise_m:g} m, voxels of {self.voxel_m:g} m: "
                f"one scan would take more than {MOST_PLACE_VOXELS} voxels; expected larger ones, "
                "or a map that reaches less far"
            )
