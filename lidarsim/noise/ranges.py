"""Errors of the range itself: noise, steps, a minimum range; and a beam that is a cone, which meets
several surfaces."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator

from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats, Ints
from lidarsim.noise.returns import Fault, Returns, View, normal, on_circle
from lidarsim.parameters import number

SIGMAS = 4.0
"""Normal noise is clipped here, so that it has a bound. Its standard deviation is 0.05 % less for
that."""


class Spread(Fault):
    """A stage that adds normal noise to ranges."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """Add noise; see `Stage.apply`.

        Returns:
            The noisy returns; those moved behind the sensor, or beyond its range, are lost.
        """
        ranges = returns.ranges
        noise = normal(ranges.shape, rng=rng)
        np.clip(noise, -SIGMAS, SIGMAS, out=noise)
        # infinite ranges stay infinite: the standard deviation must be finite for them
        noise *= self.sigma(np.minimum(ranges, view.sensor.max_range_m), view)
        return returns.but(ranges=_within_reach(ranges + noise, view))

    def sigma(self, ranges: Floats, view: View) -> Floats:
        """Compute the standard deviation of ranges.

        Args:
            ranges: Metres, of any shape.
            view: The sensor in its world.

        Returns:
            Metres, of the same shape.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Range(Spread):
    """Normal noise along the ray, of standard deviation ``sigma_m + share · r + quadratic_per_m ·
    r²``."""

    sigma_m: float = number(0.02, minimum=0, maximum=1)
    """The constant part, metres."""
    share: float = number(0.0, minimum=0, maximum=1)
    """The part that grows with the range, metres a metre."""
    quadratic_per_m: float = number(0.0, minimum=0, maximum=1)
    """The part that grows with its square, 1/metres."""

    def sigma(self, ranges: Floats, view: View | None = None) -> Floats:
        """See `Spread.sigma`.

        Args:
            ranges: Metres, of any shape.
            view: Not needed.

        Returns:
            Metres, of the same shape.
        """
        return self.sigma_m + self.share * ranges + self.quadratic_per_m * ranges**2

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return SIGMAS * float(self.sigma(np.array(max_range_m)))


@dataclass(frozen=True, kw_only=True)
class Depth(Spread):
    """Noise of a stereo camera: normal, of standard deviation ``quadratic_per_m · z²`` in depth z.

    Depth is measured along the mean of the sensor's directions; the point moves along its ray. Not
    for a sensor that looks all around.
    """

    quadratic_per_m: float = number(0.01, minimum=0, maximum=1)
    """Standard deviation of depth over its square, 1/metres: 0.005 is 2 % at 4 m."""

    def sigma(self, ranges: Floats, view: View) -> Floats:
        """See `Spread.sigma`.

        Returns:
            Metres, of the same shape: the deviation of depth z, with z = r c, moves the point along
                a ray
            of cosine c by 1/c as much.
        """
        rays = view.sensor.directions_body
        axis = rays.reshape(-1, 3).mean(axis=0)
        x, y, z = axis / math.sqrt(float((axis**2).sum()))
        # written out, for a product of matrices has other last bits on other processors
        cosine = rays[..., 0] * x + rays[..., 1] * y + rays[..., 2] * z
        return self.quadratic_per_m * ranges**2 * np.abs(cosine)

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return SIGMAS * self.quadratic_per_m * max_range_m**2


@dataclass(frozen=True, kw_only=True)
class Quantise(Fault):
    """Ranges in whole steps."""

    step_m: float = number(0.01, above=0, maximum=1)
    """The step, metres."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """Round ranges to steps; see `Stage.apply`.

        Returns:
            The rounded returns.
        """
        return returns.but(
            ranges=_within_reach(np.rint(returns.ranges / self.step_m) * self.step_m, view)
        )

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return self.step_m / 2


@dataclass(frozen=True, kw_only=True)
class Near(Fault):
    """Nothing returns from nearer than the sensor can see."""

    min_range_m: float = number(0.3, minimum=0, maximum=1000)
    """The least range, metres."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """Lose near returns; see `Stage.apply`.

        Returns:
            The same returns, with ``inf`` for the lost ones.
        """
        return returns.but(
            ranges=np.where(returns.ranges < self.min_range_m, np.inf, returns.ranges)
        )


def _within_reach(ranges: Floats, view: View) -> Floats:
    """Ranges of which those behind the sensor, or beyond its reach, are lost."""
    return np.where((ranges > 0) & (ranges <= view.sensor.max_range_m), ranges, np.inf)


GOLDEN = math.pi * (3.0 - math.sqrt(5.0))
"""The angle from one seed of a sunflower to the next, radians."""


@dataclass(frozen=True, kw_only=True)
class Divergence(Fault):
    """Every beam becomes `rays` rays, spread evenly over its cone, turned at random about its axis.

    Ranges within `resolution_m` of the nearest are one echo, at their mean: at an edge, that is a
    mixed pixel, which lies on neither surface. Returns that are farther apart form separate echoes.
    """

    order = 1
    mrad: float = number(3.0, above=0, maximum=100)
    """Full angle of the cone, thousandths of a radian."""
    returns: Literal["strongest", "first", "last", "dual"] = "strongest"
    """Which echo is told; `dual` tells the strongest and the last, where they differ. Of equally
    strong ones the nearest is the strongest."""
    rays: int = number(9, minimum=2, maximum=1000)
    """Rays a beam."""
    resolution_m: float = number(0.3, minimum=0, maximum=100)
    """How far apart two surfaces must be to be told apart, metres: half the length of the pulse."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """Cast every beam as a cone of rays; see `Stage.apply`.

        Returns:
            Returns of one echo a ray, or two.
        """
        along = returns.directions
        across, upward = _orthogonal(along)
        cosine, sine = on_circle((*along.shape[:-1], 1), rng=rng)
        axis, cross_axis = cosine * across + sine * upward, cosine * upward - sine * across
        hits = np.empty((self.rays, *along.shape[:-1]))
        for n in range(self.rays):
            # Vogel's sunflower: radii as the square root of the number cover the disc evenly. The
            # half angle is 5e-4 rad per milliradian of the full one, and taken for its tangent
            offset = 5e-4 * self.mrad * math.sqrt((n + 0.5) / self.rays)
            sine, cosine = sin_cos(n * GOLDEN)
            ray = along + offset * (cosine * axis + sine * cross_axis)
            hits[n] = view.cast(
                returns.origins, ray / np.sqrt((ray**2).sum(axis=-1, keepdims=True))
            )
        means, weights = _echoes(np.sort(hits, axis=0), self.resolution_m)
        strongest = np.argmax(weights, axis=0)
        # without any echo the index is 0, whose mean is inf
        last = np.maximum(np.count_nonzero(weights, axis=0) - 1, 0)
        # argmax takes the first of equals: the nearest
        chosen = {"first": np.zeros_like(last), "last": last}.get(self.returns, strongest)
        ranges = np.take_along_axis(means, chosen[None], axis=0)
        if self.returns == "dual":
            second = np.where(
                last == strongest, np.inf, np.take_along_axis(means, last[None], axis=0)
            )
            ranges = np.concatenate([ranges, second])
        return returns.but(ranges=ranges)

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`: along the ray by the resolution, and beside it by half the cone."""
        return self.resolution_m + max_range_m * 5e-4 * self.mrad


def _echoes(hits: Floats, resolution_m: float) -> tuple[Floats, Ints]:
    """Group rising `hits` (k, *shape) into echoes: means and counts, (k, *shape) each.

    The nearest echo is first; beyond the last are ``inf`` and 0."""
    means, weights = np.full(hits.shape, np.inf), np.zeros(hits.shape, np.int64)
    number = np.zeros(hits.shape[1:], np.int64)
    begin, total, count = hits[0], np.zeros(number.shape), number.copy()
    # all rays of the scan at once, one sub-ray after the other
    for hit in hits:
        met = np.isfinite(hit)
        new = met & (np.where(met, hit, 0.0) - np.where(met, begin, 0.0) > resolution_m)
        number += new
        begin = np.where(new, hit, begin)
        total = np.where(new, 0.0, total) + np.where(met, hit, 0.0)
        count = np.where(new, 0, count) + met
        is_open = count > 0
        np.put_along_axis(
            means,
            number[None],
            np.where(is_open, total / np.maximum(count, 1), np.inf)[None],
            axis=0,
        )
        np.put_along_axis(weights, number[None], count[None], axis=0)
    return means, weights


def _orthogonal(along: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (..., 3) at right angles to unit vectors (..., 3) and to each other."""
    # any vector that is not nearly parallel
    helper = np.where(np.abs(along[..., 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    across = np.cross(helper, along)
    across /= np.sqrt((across**2).sum(axis=-1, keepdims=True))
    return across, np.cross(along, across)
