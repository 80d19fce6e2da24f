"""Missing returns, spurious returns, and a sensor that moves while it scans: rolling shutter."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from lidarsim.elementary import exp, log, sin_cos
from lidarsim.grid import Floats, Mask
from lidarsim.noise.returns import Fault, Returns, View, grouped, normal
from lidarsim.parameters import number
from lidarsim.pose import rotate

TEN_PERCENT = 0.1
"""The reflectivity of the target for which data sheets give a range."""


class Loss(Fault):
    """A stage that loses returns, each by its own probability."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """Lose returns; see `Stage.apply`.

        Returns:
            The same returns, with ``inf`` for the lost ones.
        """
        lost = self.lost(rng.random(returns.ranges.shape), returns, view)
        return returns.but(ranges=np.where(lost, np.inf, returns.ranges))

    def lost(self, drawn: Floats, returns: Returns, view: View) -> Mask:
        """Choose the returns that are lost.

        Args:
            drawn: (echoes, *shape), uniform from 0 to 1.
            returns: The returns.
            view: The sensor in its world.

        Returns:
            (echoes, *shape): whether `drawn` is below the return's probability of loss.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Dropout(Loss):
    """Every return is lost with the same probability."""

    share: float = number(0.05, minimum=0, maximum=1)
    """The probability."""

    def lost(self, drawn: Floats, returns: Returns, view: View) -> Mask:
        """Lose all alike; see `Loss.lost`.

        Returns:
            (echoes, *shape).
        """
        return drawn < self.share


@dataclass(frozen=True, kw_only=True)
class Far(Loss):
    """A return at range r is lost with probability ``share · (r / max_range_m)^power``."""

    share: float = number(0.5, minimum=0, maximum=1)
    """The probability at the sensor's greatest range."""
    power: float = number(2.0, minimum=0, maximum=10)
    """How it grows: 1 evenly, 2 with the square."""

    def lost(self, drawn: Floats, returns: Returns, view: View) -> Mask:
        """Lose by range; see `Loss.lost`.

        Returns:
            (echoes, *shape).
        """
        part = np.minimum(returns.ranges / view.sensor.max_range_m, 1.0)
        # products give the same bits on every processor; NumPy's power does not
        whole = math.floor(self.power)
        chance = self.share * math.prod([part] * whole, start=np.ones(part.shape))
        if self.power == whole:
            return drawn < chance
        # part^fraction lies between the weighted harmonic and arithmetic means of part and 1; the
        # power itself is computed only where `drawn` lies between these two
        fraction = self.power - whole
        lost = drawn < chance * (1.0 - fraction * (1.0 - part))
        unsure = lost & (drawn >= chance * part / (part + fraction * (1.0 - part)))
        lost[unsure] = drawn[unsure] < (chance[unsure] * exp(fraction * log(part[unsure])))
        return lost


@dataclass(frozen=True, kw_only=True)
class Grazing(Loss):
    """Returns at flat angles are lost: none up to `from_deg` off the normal, all at 90°; the
    probability is linear in between."""

    from_deg: float = number(75.0, minimum=0, below=90)
    """Angle between ray and normal from which returns are lost, degrees."""

    def lost(self, drawn: Floats, returns: Returns, view: View) -> Mask:
        """Lose by the angle of incidence; see `Loss.lost`.

        Returns:
            (echoes, *shape).
        """
        cosine = view.surfaces(returns)[0]
        # lost if the ray's elevation above the surface is below a uniform angle up to the limit
        angle = math.radians(90.0 - self.from_deg) * (1.0 - drawn)
        square = angle * angle
        below = angle * (1.0 - square / 6.0)  # the sine lies between two sums of its series
        lost = cosine < below
        unsure = ~lost & (cosine < below + angle * square * square / 120.0)
        lost[unsure] = np.broadcast_to(cosine, lost.shape)[unsure] < sin_cos(angle[unsure])[0]
        return lost


@dataclass(frozen=True, kw_only=True)
class Faint(Fault):
    """Weak returns are lost.

    A surface of 10 % reflectivity, met head on, returns up to `range_m`; one of albedo ρ at an
    angle of cosine c up to ``range_m · sqrt(ρ c / 0.1)``, times ``1 + softness · n`` with n
    standard normal.
    """

    range_m: float = number(40.0, above=0, maximum=1e4)
    """The range of a target of 10 % reflectivity, metres, as data sheets have it."""
    softness: float = number(0.05, minimum=0, maximum=1)
    """How much that range varies from return to return, as a share of it."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """Lose weak returns; see `Stage.apply`.

        Returns:
            The same returns, with ``inf`` for the lost ones.
        """
        cosine, albedo = view.surfaces(returns)
        reach = self.range_m * np.sqrt(albedo * cosine / TEN_PERCENT)
        # in place: scans may have a million rays
        varied = normal(returns.ranges.shape, rng=rng)
        varied *= self.softness
        varied += 1.0
        varied *= reach
        return returns.but(ranges=np.where(returns.ranges <= varied, returns.ranges, np.inf))


@dataclass(frozen=True, kw_only=True)
class Spurious(Fault):
    """Dust, rain or glare: with probability `share`, a ray returns from a uniformly random point
    before the surface."""

    share: float = number(0.001, minimum=0, maximum=1)
    """The probability, of every ray."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """Add spurious returns; see `Stage.apply`.

        Returns:
            The same returns, with the first echo moved nearer by chance.
        """
        first = returns.ranges[0]
        # 1 - u lies above 0: a range of 0 would be no return
        chosen, place = rng.random(first.shape) < self.share, 1.0 - rng.random(first.shape)
        spurious = np.where(chosen, place * np.minimum(first, view.sensor.max_range_m), first)
        return returns.but(ranges=np.concatenate([spurious[None], returns.ranges[1:]]))

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return math.inf


@dataclass(frozen=True, kw_only=True)
class Motion(Fault):
    """The sensor moves at constant speed during the scan, and turns about the body's z axis. Each
    ray is cast from where the sensor is at its time, to one of `poses` steps.

    Points are computed as if all rays were cast from the first pose, so walls bend; if `corrected`,
    every return is where it was.
    """

    order = 0
    forward_mps: float = number(1.0, minimum=-1000, maximum=1000)
    """Speed along the body's x axis, metres a second."""
    left_mps: float = number(0.0, minimum=-1000, maximum=1000)
    """Speed along its y axis."""
    up_mps: float = number(0.0, minimum=-1000, maximum=1000)
    """Speed along its z axis."""
    yaw_rate_deg_s: float = number(0.0, minimum=-3600, maximum=3600)
    """How fast it turns, counter-clockwise seen from above, degrees a second."""
    corrected: bool = False
    """Whether the sensor knows where each ray was cast."""
    poses: int = number(100, minimum=1, maximum=10_000)
    """Poses that the scan is divided into: rays between two are cast from one in their middle."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """Cast the scan anew from a moving sensor; see `Stage.apply`.

        Returns:
            Returns of one echo a ray, and where rays began and went.
        """
        times = view.sensor.times_s
        length = float(times.max()) / self.poses
        number_of = np.minimum(times // (length or 1.0), self.poses - 1).astype(np.int64)
        body = view.sensor.directions_body
        # rays of a pose that has not moved keep the bits of the clean scan
        origins, directions = returns.origins.copy(), returns.directions.copy()
        for group in grouped(number_of):
            shift, turn = self.moved((number_of[group][0] + 0.5) * length)
            if shift.any() or turn:
                sine, cosine = sin_cos(turn / 2)
                turned = rotate([float(cosine), 0.0, 0.0, float(sine)], body[group])
                origins[group] = view.pose.position + rotate(view.pose.quaternion, shift[None])[0]
                directions[group] = rotate(view.pose.quaternion, turned)
        ranges = view.cast(origins, directions)[None]
        reported = (
            {"reported_origins": origins, "reported_directions": directions}
            if self.corrected
            else {}
        )
        return returns.but(ranges=ranges, origins=origins, directions=directions, **reported)

    def moved(self, time_s: float) -> tuple[Floats, float]:
        """Compute the sensor's motion since the scan began: an arc, or a straight line without a
        turn.

        Args:
            time_s: Seconds since then.

        Returns:
            Where it is, (3,), metres in its first frame; and its turn, radians.
        """
        rate = math.radians(self.yaw_rate_deg_s)
        turn = rate * time_s
        sine, cosine = (float(part) for part in sin_cos(turn))
        # integrals of cosine and sine of the turn over time
        ahead, aside = (sine / rate, (1.0 - cosine) / rate) if rate else (time_s, 0.0)
        x, y = self.forward_mps, self.left_mps
        return np.array([ahead * x - aside * y, aside * x + ahead * y, self.up_mps * time_s]), turn

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return 0.0 if self.corrected else math.inf
