"""Faults of a range itself: noise, steps, and a least range."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lidarsim.noise.returns import Returns, View, normal
from lidarsim.parameters import check, number

SIGMAS = 4.0
"""Normal noise is cut here, so that it has a bound; the standard deviation is 0.05 % less for
it."""


@dataclass(frozen=True, kw_only=True)
class Range:
    """Normal noise along the ray, of standard deviation ``sigma_m + share · r + quadratic_per_m ·
    r²``."""

    order: ClassVar[int] = 2
    sigma_m: float = number(0.02, least=0, most=1)
    """The constant part, metres."""
    share: float = number(0.0, least=0, most=1)
    """The part that grows with the range, metres a metre."""
    quadratic_per_m: float = number(0.0, least=0, most=1)
    """The part that grows with its square, 1/metres."""

    def __post_init__(self) -> None:
        check(self)

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        ranges = returns.ranges
        sigma = _sigma(np.where(np.isfinite(ranges), ranges, 0.0), self)
        return returns.but(ranges=_kept(ranges + sigma * _normal(ranges.shape, rng), view))

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return SIGMAS * float(_sigma(np.array(max_range_m), self))


@dataclass(frozen=True, kw_only=True)
class Depth:
    """Noise of a stereo camera: that of disparity is even, so that of depth z grows as
    ``quadratic_per_m · z²``.

    Depth is measured along the mean of the sensor's directions, a camera's optical axis; the point
    moves along its ray.
    """

    order: ClassVar[int] = 2
    quadratic_per_m: float = number(0.01, least=0, most=1)
    """Standard deviation of depth over its square, 1/metres: 0.005 is 2 % at 4 m."""

    def __post_init__(self) -> None:
        check(self)

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        rays = view.sensor.directions_body
        axis = rays.reshape(-1, 3).mean(axis=0)
        cosine = rays @ (axis / math.sqrt(float((axis**2).sum())))
        ranges = returns.ranges
        sigma = (
            self.quadratic_per_m * np.where(np.isfinite(ranges), ranges, 0.0) ** 2 * np.abs(cosine)
        )
        return returns.but(ranges=_kept(ranges + sigma * _normal(ranges.shape, rng), view))

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return SIGMAS * self.quadratic_per_m * max_range_m**2


@dataclass(frozen=True, kw_only=True)
class Quantise:
    """Ranges in whole steps."""

    order: ClassVar[int] = 2
    step_m: float = number(0.01, above=0, most=1)
    """The step, metres."""

    def __post_init__(self) -> None:
        check(self)

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        return returns.but(ranges=_kept(np.rint(returns.ranges / self.step_m) * self.step_m, view))

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return self.step_m / 2


@dataclass(frozen=True, kw_only=True)
class Near:
    """Nothing returns from nearer than the sensor can see."""

    order: ClassVar[int] = 2
    min_range_m: float = number(0.3, least=0, most=1000)
    """The least range, metres."""

    def __post_init__(self) -> None:
        check(self)

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        return returns.but(
            ranges=np.where(returns.ranges < self.min_range_m, np.inf, returns.ranges)
        )

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return 0.0


def _sigma(ranges: NDArray[np.float64], of: Range) -> NDArray[np.float64]:
    return of.sigma_m + of.share * ranges + of.quadratic_per_m * ranges**2


def _normal(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float64]:
    return np.clip(normal(shape, rng=rng), -SIGMAS, SIGMAS)


def _kept(ranges: NDArray[np.float64], view: View) -> NDArray[np.float64]:
    """Ranges of which those behind the sensor, or beyond its reach, are lost."""
    return np.where((ranges > 0) & (ranges <= view.sensor.max_range_m), ranges, np.inf)
