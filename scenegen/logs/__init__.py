"""Logs: the scans of one drive or flight, with the pose of the sensor at each.

`cruise` flies through a world, `record` scans it, and `write` puts the log on disk. `read` reads
logs, also of real sensors, from `clouds` and `poses`, and `fuse` makes maps of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from lidarsim.parameters import check, number

if TYPE_CHECKING:  # commands take their options from here, and none of these
    import numpy as np
    from numpy.typing import NDArray

    from lidarsim import Pose


@dataclass(frozen=True, eq=False)
class LogScan:
    """One scan of a log."""

    time_s: float
    """When it began, seconds."""
    pose: "Pose"
    """The sensor's in the world at that moment."""
    points: "NDArray[np.float64]"
    """(N, 3): returns in the sensor's frame, metres; not finite where nothing returned."""
    more: "Mapping[str, NDArray]" = field(default_factory=dict)
    """What else is known of each return, (N,): `intensity`; `ring`, the number of its beam; and
    `t`, when its ray was cast, seconds after the scan began."""


@dataclass(frozen=True, kw_only=True)
class Cruise:
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

    def __post_init__(self) -> None:
        check(self)
