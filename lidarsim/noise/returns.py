"""The data that noise stages pass on, the surfaces of the world for them, intensity, and random
numbers.

Normal numbers and directions of a circle are made by integers and + - * /, so with the same bits on
every processor, and at a few nanoseconds each. Each number is made of one word of 64 random bits,
so numbers are as independent of each other as the words are. If its word does not decide, further
ones follow from it by SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number
generators", 2014)."""

from dataclasses import dataclass, replace
from decimal import Context, Decimal, localcontext
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.random import Generator

from lidarsim.elementary import log_of
from lidarsim.engines import Caster
from lidarsim.grid import Floats, Ints
from lidarsim.jit import kernel
from lidarsim.parameters import Checked, number
from lidarsim.pose import Pose
from lidarsim.scan import Scan
from lidarsim.sensors import Sensor
from lidarsim.solids import colours

if TYPE_CHECKING:
    import mujoco

LAYERS = 256
"""Layers of equal area under the bell exp(-x²/2)."""
TAIL = Decimal("3.65415288536100877164542972039951576297")
"""Where the tail begins. It is part of the lowest layer."""
AREA = Decimal("0.00492867323397465534736177540233602807")
"""The area of a layer: 256 of them close the bell at its top, to 38 digits."""
TERMS = 17
"""Terms of the exponential's series: enough for 2^-60 in the second lowest layer."""
UNIT = 2.0**-53
"""A whole number of 53 bits, times this, lies from 0 to below 1."""
LAYER, SIGN = np.uint64(LAYERS - 1), np.uint64(LAYERS)
"""The bits of a word that choose the layer and the sign; the upper 53 choose the place in it."""
BELOW = np.uint64(11)
GOLDEN, FIRST, SECOND = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
)
"""SplitMix64's step, and its factors."""
HALF, LOWER, TWICE = np.uint64(32), np.uint64(2**32 - 1), 2.0**-31
"""Shift and mask for the halves of a word, and the factor from a half to the interval of 0 to 2."""
SHIFTS = (np.uint64(30), np.uint64(27), np.uint64(31))


def normal(shape: tuple[int, ...], *, rng: Generator) -> Floats:
    """Draw standard normal numbers by a ziggurat.

    Source: Marsaglia and Tsang, "The ziggurat method for generating random variables", 2000; layer
    and place in it come from separate bits, as Doornik 2005 demands.

    Args:
        shape: Of the result.
        rng: Gives one word for each number.

    Returns:
        Numbers of that shape.
    """
    words = _words(shape, rng)
    numbers = words.view(np.float64)  # each in the place of its word
    _normal(words.reshape(-1), *_layers(), numbers.reshape(-1))
    return numbers


def on_circle(shape: tuple[int, ...], *, rng: Generator) -> tuple[Floats, Floats]:
    """Draw angles uniformly from the whole turn: points of a disc, whose angle is doubled.

    Source: von Neumann 1951.

    Args:
        shape: Of the result.
        rng: Gives one word for each angle.

    Returns:
        Cosine and sine of the angles, of that shape each.
    """
    cosine, sine = np.empty(shape), np.empty(shape)
    _on_circle(_words(shape, rng).reshape(-1), cosine.reshape(-1), sine.reshape(-1))
    return cosine, sine


def _words(shape: tuple[int, ...], rng: Generator) -> Any:
    """Draw words of 64 random bits."""
    return rng.integers(0, 2**64, shape, np.uint64)


@cache
def _layers() -> tuple[Floats, Floats]:
    """Compute the ziggurat: how far out its layers reach, from the lowest to the top, and the
    density there, 257 each.

    The lowest is as wide as if its tail were part of a rectangle. Decimal numbers round their
    logarithms correctly on every processor."""
    with localcontext(Context(prec=38)):
        bell = (-TAIL * TAIL / 2).exp()
        edges, densities = [AREA / bell, TAIL], [Decimal(0), bell]
        while len(edges) < LAYERS:
            densities.append(densities[-1] + AREA / edges[-1])
            # the inverse of the density
            edges.append((-2 * densities[-1].ln()).sqrt())
    return np.array([*edges, 0], float), np.array([*densities, 1], float)


@kernel
def _mixed(state):
    """Return SplitMix64's word of a state."""
    word = (state ^ (state >> SHIFTS[0])) * FIRST
    word = (word ^ (word >> SHIFTS[1])) * SECOND
    return word ^ (word >> SHIFTS[2])


@kernel
def _share(word):
    """Convert the upper 53 bits to a number from 0 to below 1."""
    return np.int64(word >> BELOW) * UNIT


@kernel
def _normal(words, edges, densities, numbers):
    """Compute the number of every word.

    A place in a layer is accepted at once if it lies below the next layer too, else if it lies
    below the bell."""
    for n in range(len(words)):
        word = state = words[n]
        while True:
            layer = np.int64(word & LAYER)
            number = _share(word) * edges[layer]
            if number < edges[layer + 1]:
                break
            if layer == 0:
                number = _tail(state, edges[1])
                break
            state += GOLDEN
            height = densities[layer + 1] - densities[layer]
            height = densities[layer] + _share(_mixed(state)) * height
            # the bell is exp(rise) times as high here as at the layer's outer edge
            rise, ratio = 0.5 * (edges[layer] - number) * (edges[layer] + number), 1.0
            for m in range(TERMS, 0, -1):
                ratio = 1.0 + ratio * rise / m
            if height < densities[layer] * ratio:
                break
            state += GOLDEN
            word = _mixed(state)
        numbers[n] = -number if word & SIGN else number


@kernel
def _tail(state, tail):
    """A number of the tail (Marsaglia, "Generating a variable from the tail of the normal
    distribution", 1964)."""
    while True:
        state += GOLDEN
        further = -log_of(1.0 - _share(_mixed(state))) / tail
        state += GOLDEN
        if -2.0 * log_of(1.0 - _share(_mixed(state))) >= further * further:
            return tail + further


@kernel
def _on_circle(words, cosine, sine):
    """Use either half of a word as a coordinate in the square around the disc."""
    for n in range(len(words)):
        word = state = words[n]
        while True:
            # + 0.5: never 0, so the division below is safe
            x = (np.int64(word >> HALF) + 0.5) * TWICE - 1.0
            y = (np.int64(word & LOWER) + 0.5) * TWICE - 1.0
            square = x * x + y * y
            if square <= 1.0:
                break
            state += GOLDEN
            word = _mixed(state)
        # cos 2a and sin 2a of the point's angle a, without a square root
        cosine[n], sine[n] = (x * x - y * y) / square, 2.0 * x * y / square


GREY = 0.5
"""The albedo of surfaces whose colour is unknown."""


@dataclass(frozen=True, eq=False)
class Returns:
    """The returns of one scan, one or two echoes a ray."""

    ranges: Floats
    """(echoes, *shape), metres; ``inf`` where nothing returned."""
    origins: Floats
    """(*shape, 3): where every ray began, in the world."""
    directions: Floats
    """(*shape, 3): unit vectors of the rays, in the world."""
    reported_origins: Floats
    """(*shape, 3): where the ray began as the sensor reports it; other than `origins` if it moves
    without knowing."""
    reported_directions: Floats
    """(*shape, 3): the ray's direction as the sensor reports it."""
    intensity: Floats | None = None
    """(echoes, *shape), from 0 to 1; None unless a stage adds it."""

    @classmethod
    def of(cls, scan: Scan) -> "Returns":
        """The returns of a clean scan, one echo a ray."""
        directions = scan.directions
        origins = np.broadcast_to(scan.pose.position, directions.shape)
        return cls(scan.ranges.astype(np.float64)[None], origins, directions, origins, directions)

    def points(self, echo: int = 0) -> Floats:
        """Compute the returns' points of one echo as the sensor reports them, (M, 3) in the world,
        in ray order."""
        hit = np.isfinite(self.ranges[echo])
        return (
            self.reported_origins[hit]
            + self.ranges[echo][hit][:, None] * self.reported_directions[hit]
        )

    def but(self, **changes: Floats) -> "Returns":
        """Replace fields; the intensity becomes 0 where nothing returns any more."""
        changed = replace(self, **changes)
        if changed.intensity is None:
            return changed
        return replace(
            changed, intensity=np.where(np.isfinite(changed.ranges), changed.intensity, 0.0)
        )


@dataclass(frozen=True, eq=False)
class View:
    """The sensor in its world."""

    engine: Caster
    """Casts rays in the sensor's world."""
    sensor: Sensor
    pose: Pose
    """The sensor's pose in the world when the scan begins."""
    albedo: Floats | None = None
    """(geoms,): the share of light that every geom reflects, see `albedo_of`; `GREY` for all if
    None."""

    def cast(self, origins: Floats, directions: Floats) -> Floats:
        """Cast clean rays.

        Args:
            origins: (*shape, 3), metres, in the world.
            directions: (*shape, 3), unit vectors in the world.

        Returns:
            (*shape), metres; ``inf`` beyond the sensor's range.
        """
        ranges = np.empty(directions.shape[:-1])
        for group, origin in by_origin(origins):
            (ranges[group],) = self._engine_for(group).cast(
                origin[None], directions[group][None], self.sensor.max_range_m
            )
        return ranges

    def surfaces(self, returns: Returns) -> tuple[Floats, Floats]:
        """Find the surfaces that the returns' rays meet first.

        Args:
            returns: Give origins and directions.

        Returns:
            Cosine of the angle between ray and normal, and albedo, (*shape) each; 0 where nothing
            is met.

        Raises:
            ValueError: If the engine has no `hits`.
        """
        if getattr(self.engine, "hits", None) is None:
            raise ValueError(
                f"noise: {type(self.engine).__name__} does not say what surface a ray meets; use "
                "the engine analytic, or for a map only stages that change ranges"
            )
        cosine, albedo = lit = np.empty((2, *returns.directions.shape[:-1]))
        light = np.empty(0) if self.albedo is None else np.array(self.albedo, float)
        for group, origin in by_origin(returns.origins):
            directions = returns.directions[group]
            met = self._engine_for(group).hits(
                origin[None], directions[None], self.sensor.max_range_m
            )
            rays = directions.reshape(-1, 3)
            # with one origin the results are written in place
            part = lit if group is ... else np.empty((2, len(rays)))
            _reflect(
                met.geoms.reshape(-1),
                met.normals.reshape(rays.shape),
                rays,
                light,
                *part.reshape(2, len(rays)),
            )
            if group is not ...:
                cosine[group], albedo[group] = part
        return cosine, albedo

    def _engine_for(self, rays: Any) -> Any:
        """The engine for some rays of the scan, which may have times of their own."""
        of_rays = getattr(self.engine, "of_rays", None)
        return of_rays(rays) if of_rays else self.engine


@kernel
def _reflect(geoms, normals, rays, light, cosine, albedo):
    for n in range(len(geoms)):
        cosine[n] = albedo[n] = 0.0
        if geoms[n] >= 0:
            x, y, z = normals[n]
            incidence = abs(x * rays[n, 0] + y * rays[n, 1] + z * rays[n, 2])
            cosine[n] = (
                incidence if incidence > 0.0 else 0.0
            )  # a triangle without area has no normal
            albedo[n] = light[geoms[n]] if len(light) else GREY


def albedo_of(model: "mujoco.MjModel") -> Floats:
    """Compute the share of light that every geom reflects, (ngeom,).

    It is the brightness of the material's colour, or of the geom's own without a material, by the
    weights of ITU-R BT.709. Textures are ignored."""
    red, green, blue, _ = colours(model).T
    return np.clip((0.2126 * red + 0.7152 * green) + 0.0722 * blue, 0.0, 1.0)


def by_origin(origins: Floats) -> list[tuple[Any, Floats]]:
    """Group rays by origin.

    Args:
        origins: (*shape, 3).

    Returns:
        Indices of arrays (*shape), each with its origin (3,).
    """
    if not any(origins.strides[:-1]):  # broadcast from one, as `Returns.of` has it
        return [(..., origins[(0,) * (origins.ndim - 1)])]
    flat = origins.reshape(-1, 3)
    # rays in a row mostly share theirs: only the first of each such run is sorted
    begins = np.flatnonzero(np.append(True, (flat[1:] != flat[:-1]).any(axis=1)))
    places, group_of = np.unique(flat[begins], axis=0, return_inverse=True)
    number = np.repeat(group_of.reshape(-1), np.diff(begins, append=len(flat)))
    return list(zip(grouped(number.reshape(origins.shape[:-1])), places, strict=True))


def grouped(number: Ints) -> list[Any]:
    """Group the elements of `number` (*shape) by value: an index of arrays (*shape) for each,
    rising."""
    # stable, so that rays of a group stay in order
    order = np.argsort(number, axis=None, kind="stable")
    begins = np.flatnonzero(np.diff(number.reshape(-1)[order])) + 1
    return [np.unravel_index(part, number.shape) for part in np.split(order, begins)]


class Fault(Checked):
    """Base of most stages: it changes returns, and moves none."""

    order: ClassVar[int] = 2

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Intensity(Fault):
    """Intensity from 0 to 1: albedo × cosine of the angle of incidence, without fall-off by range,
    as sensors report it, plus normal noise of `sigma`."""

    sigma: float = number(0.0, minimum=0, maximum=1)
    """Standard deviation of the noise."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """Add intensity; see `Stage.apply`.

        Returns:
            The same ranges with intensity, (echoes, *shape).
        """
        cosine, albedo = view.surfaces(returns)
        noise = self.sigma * normal(returns.ranges.shape, rng=rng)
        return returns.but(intensity=np.clip(albedo * cosine + noise, 0.0, 1.0))
