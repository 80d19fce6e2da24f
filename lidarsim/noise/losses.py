"""Returns that go missing, and returns of nothing."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lidarsim.noise.chance import normal
from lidarsim.noise.returns import Returns, View
from lidarsim.parameters import check, number

TEN_PERCENT = 0.1
"""The reflectivity for which data sheets give a range."""


class Loss:
    """A stage that takes returns away and moves none."""

    order: ClassVar[int] = 2

    def __post_init__(self) -> None:
        check(self)

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Dropout(Loss):
    """Every return is lost with the same probability."""

    share: float = number(0.05, least=0, most=1)
    """The probability."""

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        return _lost(returns, self.share, rng)


@dataclass(frozen=True, kw_only=True)
class Far(Loss):
    """A return at range r is lost with probability ``share · (r / max_range_m)^power``."""

    share: float = number(0.5, least=0, most=1)
    """The probability at the sensor's greatest range."""
    power: float = number(2.0, least=0, most=10)
    """How it grows: 1 evenly, 2 with the square."""

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        part = np.minimum(returns.ranges / view.sensor.max_range_m, 1.0)
        return _lost(returns, self.share * part**self.power, rng)


@dataclass(frozen=True, kw_only=True)
class Grazing(Loss):
    """Returns of surfaces met at a flat angle are lost: none up to `from_deg` off the normal, all
    at 90°, and with a probability that grows evenly between."""

    from_deg: float = number(75.0, least=0, below=90)
    """Angle between ray and normal from which returns are lost, degrees."""

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        angle = np.degrees(np.arccos(np.clip(view.surfaces(returns)[0], 0.0, 1.0)))
        return _lost(
            returns, np.clip((angle - self.from_deg) / (90.0 - self.from_deg), 0.0, 1.0), rng
        )


@dataclass(frozen=True, kw_only=True)
class Faint(Loss):
    """Returns too weak to be found: light falls with the square of the range, and grows with albedo
    × cosine.

    A surface of 10 % reflectivity, met head on, is found up to `range_m`; one of albedo ρ at an
    angle of cosine c up to ``range_m · sqrt(ρ c / 0.1)``, times ``1 + softness · n`` with n
    standard normal.
    """

    range_m: float = number(40.0, above=0, most=1e4)
    """The range of a target of 10 % reflectivity, metres, as data sheets have it."""
    softness: float = number(0.05, least=0, most=1)
    """How much that range varies from return to return, as a share of it."""

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        cosine, albedo = view.surfaces(returns)
        reach = self.range_m * np.sqrt(albedo * cosine / TEN_PERCENT)
        reach = reach * (1.0 + self.softness * normal(returns.ranges.shape, rng=rng))
        return returns.but(ranges=np.where(returns.ranges <= reach, returns.ranges, np.inf))


@dataclass(frozen=True, kw_only=True)
class Spurious:
    """Returns of dust, rain or glare: with probability `share` a ray returns from anywhere before
    what it would have met, evenly along its way."""

    order: ClassVar[int] = 2
    share: float = number(0.001, least=0, most=1)
    """The probability, of every ray."""

    def __post_init__(self) -> None:
        check(self)

    def apply(self, returns: Returns, view: View, *, rng: np.random.Generator) -> Returns:
        """See `Stage.apply`."""
        first = returns.ranges[0]
        chosen, where = rng.random(first.shape) < self.share, 1.0 - rng.random(first.shape)
        spurious = np.where(chosen, where * np.minimum(first, view.sensor.max_range_m), first)
        return returns.but(ranges=np.concatenate([spurious[None], returns.ranges[1:]]))

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return math.inf


def _lost(
    returns: Returns, share: float | NDArray[np.float64], rng: np.random.Generator
) -> Returns:
    """Returns of which each is lost with the probability `share`, one for all or one for each
    ray."""
    lost = rng.random(returns.ranges.shape) < share
    return returns.but(ranges=np.where(lost, np.inf, returns.ranges))
