"""Logs: the scans of one drive or flight, with the pose of the sensor at each.

`record` flies through a world, scans it, and puts the log on disk. `read` reads logs, also of real
sensors, and `fuse` makes maps of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lidarsim.parameters import MIN_RETURN_M, Checked, check, number
from scenegen.base.errors import DatasetError
from scenegen.base.files import check_free
from scenegen.base.limits import MAX_PLACE_VOXELS

if TYPE_CHECKING:  # commands take their options from here, and none of these
    from numpy.typing import NDArray

    from lidarsim import Pose
    from lidarsim.grid import Floats


@dataclass(frozen=True, eq=False)
class Box:
    """Where a mover was in one scan: the least upright box around it."""

    track: int
    """Number of the mover in the log, from 1 on."""
    kind: str
    """Of `scenegen.worlds.traffic.KINDS`."""
    time_s: float
    """When it was there, seconds: the mean time of its points in the scan, or when the scan
    began."""
    bottom: "Floats"
    """(3,): the middle of its lower face in the world, metres."""
    yaw: float
    """Direction of its length in the world, radians, counter-clockwise from x."""
    size: "Floats"
    """(3,): length, width and height, metres."""


@dataclass(frozen=True, eq=False)
class LogScan:
    """One scan of a log."""

    time_s: float
    """When it began, seconds."""
    pose: "Pose"
    """The sensor's pose in the world at that moment."""
    points: "Floats"
    """(N, 3): returns in the sensor's frame, metres; not finite where nothing returned."""
    more: "Mapping[str, NDArray]" = field(default_factory=dict)
    """Further values of each return, (N,): `intensity`; `ring`, the number of its beam; `t`, when
    its ray was cast, seconds after `time_s`; and `mover`, the track that it lies on, or 0."""
    boxes: "Sequence[Box]" = ()
    """All movers of the world, by track."""


@dataclass(frozen=True, kw_only=True)
class Cruise(Checked):
    """How a sensor flies while it records a log."""

    length_m: float = number(100.0, above=0, maximum=1e5)
    """Length of the flight, metres."""
    speed_mps: float = number(2.0, minimum=0.1, maximum=50)
    """Speed, metres a second; it is less round corners."""
    acceleration_mps2: float = number(4.0, minimum=0.1, maximum=100)
    """Maximum acceleration along the path and, separately, across it in bends, metres a second
    squared."""
    yaw_rate_deg_s: float = number(60.0, above=0, maximum=360)
    """Maximum yaw rate, degrees a second. The body faces along the flight within this limit."""


@dataclass(frozen=True, kw_only=True)
class Fusing:
    """How a log becomes maps."""

    voxel_m: float = number(0.2, minimum=0.01, maximum=10)
    """Edge of a map's voxel, metres."""
    reach_m: float = number(30.0, above=0, maximum=1000)
    """Maximum length of a ray, metres: a farther return only frees the voxels up to here."""
    rise_m: float = number(10.0, above=0, maximum=1000)
    """Height of the map above the sensor, and its depth below it, metres."""
    least_m: float = number(MIN_RETURN_M, minimum=0, maximum=100)
    """Minimum range of a return, metres; nearer ones are of the vehicle itself."""
    moved_share: float = number(0.2, minimum=0, below=1)
    """A voxel is occupied if at least this share of the scans that observed it have a return in
    it, else free: something moved. Scans that found it free and have a return beside it do not
    count, because rays graze surfaces."""
    every: int = number(10, minimum=1, maximum=10**6)
    """One scan in so many is written as an observation."""
    deskew: bool = False
    """Whether each point of a raw scan is corrected by its time for the sensor's motion."""

    def __post_init__(self) -> None:
        check(self)
        # the window of one scan: twice the reach, and some voxels around it
        wide, high = 2 * self.reach_m / self.voxel_m + 8, 2 * self.rise_m / self.voxel_m + 8
        if wide * wide * high > MAX_PLACE_VOXELS:
            raise ValueError(
                f"reach {self.reach_m:g} m, rise {self.rise_m:g} m, voxels of {self.voxel_m:g} m: "
                f"one scan would take more than {MAX_PLACE_VOXELS} voxels; expected larger "
                "voxels, or a shorter reach or rise"
            )


def check_log(path: Path) -> None:
    """Check that a log can be written: nothing is there, and the name is of a folder or an .mcap
    file.

    Raises:
        DatasetError: if it cannot.
    """
    # letters after the last point: the name of a file, not of a folder such as v0.5
    if path.suffix != ".mcap" and path.suffix[1:2].isalpha():
        raise DatasetError(f"{path}: expected a name that ends in .mcap, or has no suffix")
    check_free(path)
