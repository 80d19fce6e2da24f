"""One turn of the sensor: cast every ray, keep the ranges."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.engines import Caster
from lidarsim.grid import Field, Floats
from lidarsim.pose import Pose, rotate
from lidarsim.sensors import Sensor, check_sensor


@dataclass(frozen=True, eq=False)
class Scan:
    """What a LiDAR at a pose returned. `ranges` alone is measured: everything else about the rays
    follows. Raises ValueError for ranges that are not a number from 0 on, or inf, for each ray, and
    for a `lidar` that is no sensor."""

    ranges: Field
    """(*lidar.shape), metres along each ray; ``inf`` where nothing returned."""
    pose: Pose
    lidar: Sensor

    def __post_init__(self) -> None:
        check_sensor(self.lidar)
        shape, expected = np.shape(self.ranges), tuple(self.lidar.shape)
        if shape != expected:
            raise ValueError(f"scan: ranges of shape {shape}, expected {expected}, as its sensor's")
        if not (np.asarray(self.ranges) >= 0).all():
            raise ValueError(
                "scan: ranges below 0, or NaN; expected metres, or inf where nothing returned"
            )

    @property
    def directions(self) -> Floats:
        """Unit vectors of the rays, (*lidar.shape, 3), in the world."""
        return rotate(self.pose.quaternion, self.lidar.directions_body)

    def points(self) -> Floats:
        """The returns, (M, 3) in the world, in ray order."""
        hit = np.isfinite(self.ranges)
        ranges = self.ranges[hit].astype(np.float64)[:, None]
        return self.pose.position + ranges * self.directions[hit]


def mounted(lidar: Sensor, pose: Pose) -> Pose:
    """The pose of the sensor on a body at `pose`: moved by the sensor's `lever_arm_m`, if it has
    one. Raises ValueError where it is none."""
    check_sensor(lidar)
    if any(arm := getattr(lidar, "lever_arm_m", ())):
        return Pose(pose.position + rotate(pose.quaternion, [arm])[0], pose.quaternion)
    return pose


def cast(engine: Caster, lidar: Sensor, pose: Pose) -> Scan:
    """Scan the engine's world with `lidar` carried by a body at `pose`. The scan's pose is that of
    the sensor, as `mounted` has it.

    Raises ValueError where `lidar` is no sensor, and where the engine gives what are no ranges of
    its rays.
    """
    pose = mounted(lidar, pose)
    directions = rotate(pose.quaternion, lidar.directions_body)
    ranges = np.asarray(engine.cast(pose.position[None], directions[None], lidar.max_range_m))
    name, expected = type(engine).__name__, (1, *lidar.shape)
    if ranges.shape != expected:
        raise ValueError(f"{name}.cast gave ranges of shape {ranges.shape}, expected {expected}")
    check_ranges(ranges, lidar, f"{name}.cast")
    return Scan(ranges[0].astype(np.float32), pose, lidar)


def check_ranges(ranges: NDArray[Any], lidar: Sensor, giver: str) -> None:
    """Check ranges of any shape, metres, that somebody's code gave; the error names the `giver`.

    Raises ValueError unless each, as the float32 that a scan keeps, lies from 0 to the sensor's
    range, or is inf.
    """
    most = lidar.max_range_m
    with np.errstate(over="ignore"):
        kept = ranges.astype(np.float32)
    if wrong := np.count_nonzero(
        ~((kept >= 0) & ((kept <= np.float32(most)) | np.isposinf(ranges)))
    ):
        raise ValueError(
            f"{giver} gave {wrong} ranges that are not from 0 to {most:g} m; expected metres, or "
            f"inf for no return"
        )
