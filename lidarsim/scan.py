"""One turn of the sensor: cast every ray, keep the ranges."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.engines import Caster
from lidarsim.grid import Field, Floats, Mask
from lidarsim.parameters import MAX_LENGTH_M, MIN_RETURN_M
from lidarsim.pose import Pose, rotate
from lidarsim.sensors import Sensor, check_sensor

MIN_REPEATED, REPEATED_SHARE = 20, 0.01
"""Equal points are not returns if they are this many, and this share of all."""


@dataclass(frozen=True, eq=False)
class Scan:
    """The returns of a LiDAR at a pose. Only `ranges` is measured; the rays follow from pose and
    sensor.

    Raises ValueError if `ranges` are not one number from 0 on, or inf, for each ray, or `lidar` is
    not a sensor."""

    ranges: Field
    """(*lidar.shape), metres along each ray; ``inf`` where nothing returned."""
    pose: Pose
    """The sensor's pose in the world."""
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
        """Compute the returns' points, (M, 3) in the world, metres, in ray order."""
        hit = np.isfinite(self.ranges)
        # float32 would round places far from the world's origin to millimetres
        ranges = self.ranges[hit].astype(np.float64)[:, None]
        return self.pose.position + ranges * self.directions[hit]


def mounted(lidar: Sensor, pose: Pose) -> Pose:
    """Compute the pose of a sensor on a body, moved by the sensor's `lever_arm_m` if it has one.

    Args:
        lidar: The sensor.
        pose: The body's pose.

    Returns:
        The sensor's pose; the same attitude.

    Raises:
        ValueError: If `lidar` is not a sensor.
    """
    check_sensor(lidar)
    if any(arm := getattr(lidar, "lever_arm_m", ())):
        return Pose(pose.position + rotate(pose.quaternion, [arm])[0], pose.quaternion)
    return pose


def cast(engine: Caster, lidar: Sensor, pose: Pose) -> Scan:
    """Scan the engine's world with a sensor on a body.

    Args:
        engine: Knows the world.
        lidar: The sensor.
        pose: The body's pose; the scan's pose is the sensor's, see `mounted`.

    Returns:
        The scan, without noise.

    Raises:
        ValueError: If `lidar` is not a sensor, or the engine gives no valid range for each ray.
    """
    pose = mounted(lidar, pose)
    directions = rotate(pose.quaternion, lidar.directions_body)
    ranges = np.asarray(engine.cast(pose.position[None], directions[None], lidar.max_range_m))
    name, expected = type(engine).__name__, (1, *lidar.shape)
    if ranges.shape != expected:
        raise ValueError(f"{name}.cast gave ranges of shape {ranges.shape}, expected {expected}")
    check_ranges(ranges, lidar, f"{name}.cast")
    return Scan(ranges[0].astype(np.float32), pose, lidar)


def is_return(ranges: ArrayLike, min_range_m: float = MIN_RETURN_M) -> Mask:
    """Select returns among ranges, some of which stand for rays without a return.

    Args:
        ranges: Metres from the sensor, of any shape.
        min_range_m: The sensor's minimum range, metres.

    Returns:
        Whether each range is finite, above 0, not below `min_range_m`, and below `MAX_LENGTH_M`.
    """
    # comparisons are False for NaN, and infinity exceeds the limit
    metres = np.asarray(ranges)
    return np.asarray((metres > 0) & (metres >= min_range_m) & (metres < MAX_LENGTH_M))


def are_returns(
    points: Floats, sensors: ArrayLike = (0.0, 0.0, 0.0), min_range_m: float = MIN_RETURN_M
) -> Mask:
    """Select the returns among a scan's points, see `is_return`.

    Drivers write 0 0 0, NaN or infinity for a ray without a return. If the cloud was moved into
    another frame, the zeros lie at the sensor; if the sensor's place is unknown, they are one point
    that occurs again and again, see `_repeated`.

    Args:
        points: (N, 3), metres.
        sensors: Where they were seen from, in the frame of the points, (3,), (1, 3) or (N, 3),
            metres.
        min_range_m: The sensor's minimum range, metres.

    Returns:
        (N,): whether each is a return.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # infinity less infinity
        ranges = np.sqrt(((points - np.asarray(sensors, float)) ** 2).sum(axis=1))
    return is_return(ranges, min_range_m) & points.any(axis=1) & ~_repeated(points)


def _repeated(points: Floats) -> Mask:
    """Return which points (N, 3) are the one point that many rays share bit for bit.

    No surface gives such points; drivers write them for rays without a return. Rays without a
    return follow one another, so only points equal to the one before them are counted. The two
    echoes of a ray may be equal, but those of another ray are another pair."""
    alike = points[1:][(points[1:] == points[:-1]).all(axis=1)]
    if len(alike) < max(MIN_REPEATED, REPEATED_SHARE * len(points)):
        return np.zeros(len(points), bool)
    places, counts = np.unique(alike, axis=0, return_counts=True)
    # `alike` holds all repeated points; the test above let pass what several of them share
    if counts.max() < max(MIN_REPEATED, REPEATED_SHARE * len(points)):
        return np.zeros(len(points), bool)
    return np.asarray((points == places[counts.argmax()]).all(axis=1))


def check_ranges(ranges: NDArray[Any], lidar: Sensor, giver: str) -> None:
    """Check ranges that code outside this package gave.

    Args:
        ranges: Metres, of any shape.
        lidar: The sensor that they are of.
        giver: The name of the code, for the message.

    Raises:
        ValueError: Unless each range, rounded to float32 as a scan stores it, lies from 0 to the
            sensor's range, or is inf.
    """
    limit = lidar.max_range_m
    with np.errstate(over="ignore"):
        stored = ranges.astype(np.float32)
    if wrong := np.count_nonzero(
        # the limit is rounded as the ranges are: 0.1 in float32 exceeds 0.1
        ~((stored >= 0) & ((stored <= np.float32(limit)) | np.isposinf(ranges)))
    ):
        raise ValueError(
            f"{giver} gave {wrong} ranges that are not from 0 to {limit:g} m; expected metres, or "
            f"inf for no return"
        )
