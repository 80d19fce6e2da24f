"""A sensor that moves while it scans: rolling shutter."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lidarsim.elementary import sin_cos
from lidarsim.noise.returns import Returns, View
from lidarsim.parameters import check, number
from lidarsim.pose import rotate


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The sensor moves on at an even pace, and turns about the body's z axis through itself, from
    the scan's begin; every ray is cast from where the sensor is at the ray's time.

    A sensor that does not know of its motion takes all rays to be cast from the pose at the begin:
    walls bend. One that `corrected` its scan places every return where it was.
    """

    order: ClassVar[int] = 0
    forward_mps: float = number(1.0, least=-1000, most=1000)
    """Speed along the body's x axis, metres a second."""
    left_mps: float = number(0.0, least=-1000, most=1000)
    """Speed along its y axis."""
    up_mps: float = number(0.0, least=-1000, most=1000)
    """Speed along its z axis."""
    yaw_rate_deg_s: float = number(0.0, least=-3600, most=3600)
    """How fast it turns, counter-clockwise seen from above, degrees a second."""
    corrected: bool = False
    """Whether the sensor knows where each ray was cast."""
    poses: int = number(100, least=1, most=10_000)
    """Poses that the scan is divided into: rays between two are cast from one in their middle."""

    def __post_init__(self) -> None:
        check(self)

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        times = view.sensor.times_s
        length = float(times.max()) / self.poses
        number_of = (
            np.minimum(times // length, self.poses - 1).astype(np.int64)
            if length
            else np.zeros_like(times, int)
        )
        body = view.sensor.directions_body
        origins, directions = returns.origins.copy(), returns.directions.copy()
        for n in np.unique(number_of):
            now = number_of == n
            shift, turn = self.moved((n + 0.5) * length)
            if shift.any() or turn:
                sine, cosine = sin_cos(turn / 2)
                turned = rotate([float(cosine), 0.0, 0.0, float(sine)], body[now])
                origins[now] = view.pose.position + rotate(view.pose.quaternion, shift[None])[0]
                directions[now] = rotate(view.pose.quaternion, turned)
        ranges = view.cast(origins, directions)[None]
        told = {"told_origins": origins, "told_directions": directions} if self.corrected else {}
        return returns.but(ranges=ranges, origins=origins, directions=directions, **told)

    def moved(self, time_s: float) -> tuple[NDArray[np.float64], float]:
        """How far the sensor is from where it began, (3,) metres in its first frame, and by how
        much it turned, radians: an arc, or a straight line where it does not turn."""
        rate = math.radians(self.yaw_rate_deg_s)
        turn = rate * time_s
        sine, cosine = (float(part) for part in sin_cos(turn))
        ahead, aside = (sine / rate, (1.0 - cosine) / rate) if rate else (time_s, 0.0)
        x, y = self.forward_mps, self.left_mps
        return np.array([ahead * x - aside * y, aside * x + ahead * y, self.up_mps * time_s]), turn

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return 0.0 if self.corrected else math.inf
