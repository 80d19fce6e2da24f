"""Common base of all kinds of worlds, and random draws with the same bits on every processor."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from lidarsim.elementary import exp, log, sin_cos
from lidarsim.grid import Floats
from lidarsim.parameters import Bounds, check, short_repr
from lidarsim.solids import BOX
from scenegen.base.limits import MAX_DRAWN_M, MAX_DRAWN_SOLIDS
from scenegen.worlds.classes import CLASSES
from scenegen.worlds.drawing import Drawing
from scenegen.worlds.kinds.parts import Parts

Range = tuple[float, float]
"""A lower and an upper bound, both included; worlds or solids draw from between."""
Size = tuple[float, float, float]
"""Extents along x, y and z, metres."""


@dataclass(frozen=True, kw_only=True)
class WorldKind(ABC):
    """Parameters of a kind of world, and how to draw one.

    Worlds span x and y from 0 to `size_m`; the ground is z = 0."""

    version: ClassVar[int]
    """The preset's version: raised whenever the same parameters would give other worlds, or the
    defaults change."""
    crowded_by: ClassVar[tuple[str, ...]]
    """The parameters to lower when worlds are too crowded to fly through, and to raise when they
    are too empty; with a minus before it, one to raise and lower: ``("crown_m", "-row_m")``."""
    flight_defaults: ClassVar[dict[str, object]] = {}
    """Fields of `scenegen.worlds.flight.FlightConfig` in which this kind's preset differs from the
    general default."""
    accept_defaults: ClassVar[dict[str, object]] = {}
    """The same for `scenegen.worlds.recipe.Acceptance`."""

    for_training: ClassVar[bool] = True
    """Whether methods may train on these worlds. If not, the kind has a test split only, and
    `mixed` leaves it out, so that no network has seen its worlds."""

    movers: ClassVar[tuple[str, ...]] = ("person", "drone")
    """Kinds of movers that belong in these worlds, see `scenegen.worlds.traffic.KINDS`."""

    shares: ClassVar[tuple[str, ...]] = ()
    """The parameters that are shares of one whole."""
    graded: ClassVar[dict[str, dict[str, object]]] = {}
    """The parameters in which the presets called "easy" and "hard" differ from the defaults, which
    are "medium"."""

    size_m: Size = (40.0, 40.0, 10.0)
    """Extent along x and y, metres; along z, how high floating solids may have their centres."""
    # `scored_voxels` of scenegen.draw.scored reads these two from manifests
    ground: bool = False
    """Whether there is a floor: a slab over the world's plan with its top at z = 0."""
    ground_m: float = 0.2
    """Thickness of that slab, metres."""

    def __post_init__(self) -> None:
        # a kind's limits must hold before a world is drawn: drawing could take all memory
        check(self, bounds_by_name)
        if (total := sum(getattr(self, name) for name in self.shares)) > 1:
            raise ValueError(f"{' + '.join(self.shares)} = {total}: expected at most 1")
        solids = self.max_solids()
        if solids > MAX_DRAWN_SOLIDS:
            parameters = ", ".join(
                f"{(plain := name.removeprefix('-'))} = {short_repr(getattr(self, plain))}"
                for name in self.crowded_by
            )
            raise ValueError(
                f"{parameters}: up to {solids:.4g} solids in a world of {list(self.size_m)} "
                f"metres, expected {MAX_DRAWN_SOLIDS} at most; have fewer, or lower size_m"
            )

    def max_solids(self) -> float:
        """Return the greatest number of solids in a world.

        By default, parameters named `…density` count them per square metre; a kind that counts
        otherwise overrides this."""
        densities = [value for name, value in vars(self).items() if name.endswith("density")]
        # a density may be one number, or the ends of a range
        return float(sum(np.max(value) for value in densities)) * self.size_m[0] * self.size_m[1]

    def mover_zones(self, bounds: Floats) -> dict[str, list[Floats]]:
        """Return where movers belong, by their kind: boxes (2, 3), metres, that hold the corners of
        their courses. By default, all of them belong everywhere.

        Args:
            bounds: (2, 3): the box in which the sensor flies, metres.
        """
        return {name: [bounds] for name in self.movers}

    @abstractmethod
    def add_to(self, spec: Drawing, *, rng: Generator) -> None:
        """Draw one world and add its solids to `spec`.

        Args:
            spec: Takes solids by `add_geoms` or `add_geom`, or as any `mujoco.MjSpec`.
            rng: Decides everything that is random.
        """

    def begun(self, of_class: str) -> Parts:
        """Begin a world with the floor, if it has one, of this class."""
        parts, (x, y, _) = Parts(), self.size_m
        if self.ground:
            parts.box(of_class, (0, 0, -self.ground_m), (x, y, 0))
        return parts

    def add_ground(self, spec: Drawing) -> None:
        """Add the floor, if there is one, to worlds whose solids have no classes."""
        if self.ground:
            x, y, _ = self.size_m
            half, centre = (x / 2, y / 2, self.ground_m / 2), (x / 2, y / 2, -self.ground_m / 2)
            spec.add_geom(BOX, half, centre, rgba=(0.55, 0.53, 0.5, 1.0))


class Classed(WorldKind):
    """A kind whose solids all have classes."""

    classes = CLASSES
    """Names of the classes that they may have."""


def bounds_by_name(name: str, value: Any) -> Bounds:
    """Return the bounds of a parameter that declares none, by its name's ending; ranges of two
    rise.

    Args:
        name: The parameter's name.
        value: Its value.

    Returns:
        Its bounds.
    """
    pair = isinstance(value, list | tuple) and len(value) == 2
    if name.endswith("_share"):
        return Bounds(minimum=0, maximum=1, rising=pair)
    if name.endswith("_m"):
        return Bounds(above=0, maximum=MAX_DRAWN_M, rising=pair)
    if name.endswith("density") or pair:
        return Bounds(minimum=0, rising=pair)
    return Bounds()


def yaw_quaternion(yaw_rad: ArrayLike) -> Floats:
    """Compute quaternions (..., 4), w x y z, of turns (...) about the vertical."""
    sine, cosine = sin_cos(np.asarray(yaw_rad) / 2)
    still = np.zeros_like(sine)
    return np.stack([cosine, still, still, sine], axis=-1)


def log_uniform(low: float, high: float, *, rng: Generator) -> float:
    """Draw one number whose logarithm is uniform.

    Args:
        low: The lower bound, above 0.
        high: The upper bound.
        rng: Draws it.

    Returns:
        The number.
    """
    return float(exp(rng.uniform(*log([low, high]))))


def normal(shape: tuple[int, ...], *, rng: Generator) -> Floats:
    """Draw standard normal numbers, two from each point of a disc (Marsaglia's polar method).

    Args:
        shape: Of the result.
        rng: Draws the points.

    Returns:
        Numbers of that shape.
    """
    # not the generator's own, whose bits depend on the C library's logarithm
    count = int(np.prod(shape))
    points, square = _disc((count + 1) // 2, rng=rng)
    return (
        (points * np.sqrt(-2.0 * log(square) / square)[:, None]).reshape(-1)[:count].reshape(shape)
    )


def attitudes(count: int, tilted_share: float, *, rng: Generator) -> Floats:
    """Draw attitudes: for a share, uniform over all (Marsaglia 1972), for the rest turns about the
    vertical.

    Args:
        count: How many.
        tilted_share: The share of tilted ones.
        rng: Draws them.

    Returns:
        Unit quaternions (count, 4), w x y z.
    """
    tilted = rng.random(count) < tilted_share
    turn, square = _disc(count, rng=rng)
    tilt, tilt_square = _disc(count, rng=rng)
    # uniform on the sphere in four dimensions: a point of one disc, and one of another scaled to
    # the rest of the length
    tilt *= np.where(tilted, np.sqrt((1.0 - square) / tilt_square), 0.0)[:, None]
    # without tilt, the first disc's angle alone is half the turn
    turn /= np.where(tilted, 1.0, np.sqrt(square))[:, None]
    return np.stack([turn[:, 0], tilt[:, 0], tilt[:, 1], turn[:, 1]], axis=1)


def _disc(count: int, *, rng: Generator) -> tuple[Floats, Floats]:
    """Draw points (count, 2) uniform in the unit disc without its centre, and their squared
    distances (count,) from it."""
    points, square = np.zeros((count, 2)), np.zeros(count)
    missing = np.arange(count)
    while len(missing):
        drawn = 2.0 * rng.random((len(missing), 2)) - 1.0
        points[missing] = drawn
        square[missing] = drawn[:, 0] * drawn[:, 0] + drawn[:, 1] * drawn[:, 1]
        # points of the square around the disc are drawn again until they lie in it
        missing = missing[(square[missing] >= 1.0) | (square[missing] == 0.0)]
    return points, square
