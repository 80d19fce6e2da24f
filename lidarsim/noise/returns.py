"""What stages of noise pass on, what they may ask of the world, how bright a return is; and the
random numbers that they draw.

Normal numbers and directions of a circle are made by integers and + - * /, so with the same bits on
every processor, and at a few nanoseconds each. Each number is made of one word of 64 random bits,
and of nothing else: numbers are as independent of each other as the words are. Where its word alone
does not decide, further ones follow from it by SplitMix64 (Steele, Lea and Flood, "Fast splittable
pseudorandom number generators", 2014).
"""

from dataclasses import dataclass, replace
from decimal import Context, Decimal, localcontext
from functools import cache
from typing import Any, ClassVar

import mujoco
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

LAYERS = 256
"""Layers of equal area under the bell exp(-x²/2)."""
TAIL = Decimal("3.65415288536100877164542972039951576297")
"""Where the tail begins, which is part of the lowest layer."""
AREA = Decimal("0.00492867323397465534736177540233602807")
"""The area of a layer: 256 of them close the bell at its top, to 38 digits."""
TERMS = 17
"""Of the exponential's series: enough for 2^-60 where a layer is as high as the lowest but one."""
UNIT = 2.0**-53
"""A whole number of 53 bits, times this, lies from 0 to below 1."""
LAYER, SIGN = np.uint64(LAYERS - 1), np.uint64(LAYERS)
"""The bits of a word that choose the layer and the sign; the upper 53 say how far out."""
BELOW = np.uint64(11)
GOLDEN, FIRST, SECOND = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
)
"""SplitMix64's step, and its factors."""
HALF, LOWER, TWICE = np.uint64(32), np.uint64(2**32 - 1), 2.0**-31
"""Either half of a word as a whole number, and what takes it to a coordinate from -1 to 1."""
SHIFTS = (np.uint64(30), np.uint64(27), np.uint64(31))


def normal(shape: tuple[int, ...], *, rng: Generator) -> Floats:
    """Standard normal numbers of any shape by a ziggurat (Marsaglia and Tsang, "The ziggurat method
    for generating random variables", 2000; with the layer and the place in it from bits of their
    own, as Doornik 2005 asks)."""
    words = _words(shape, rng)
    numbers = words.view(np.float64)  # each in the place of its word
    _normal(words.reshape(-1), *_layers(), numbers.reshape(-1))
    return numbers


def on_circle(shape: tuple[int, ...], *, rng: Generator) -> tuple[Floats, Floats]:
    """Cosine and sine of angles drawn evenly from the whole turn, of any shape: points of a disc,
    whose angle is doubled (von Neumann 1951)."""
    cosine, sine = np.empty(shape), np.empty(shape)
    _on_circle(_words(shape, rng).reshape(-1), cosine.reshape(-1), sine.reshape(-1))
    return cosine, sine


def _words(shape: tuple[int, ...], rng: Generator) -> Any:
    """Words of 64 random bits."""
    return rng.integers(0, 2**64, shape, np.uint64)


@cache
def _layers() -> tuple[Floats, Floats]:
    """How far out the layers reach, from the lowest to the top, and the bell's density there, 257
    each. The lowest is as wide as if its tail were part of a rectangle. Decimal numbers round their
    logarithms right, whatever the processor."""
    with localcontext(Context(prec=38)):
        bell = (-TAIL * TAIL / 2).exp()
        edges, densities = [AREA / bell, TAIL], [Decimal(0), bell]
        while len(edges) < LAYERS:
            densities.append(densities[-1] + AREA / edges[-1])
            edges.append((-2 * densities[-1].ln()).sqrt())
    return np.array([*edges, 0], float), np.array([*densities, 1], float)


@kernel
def _mixed(state):
    """The word of SplitMix64 at a state."""
    word = (state ^ (state >> SHIFTS[0])) * FIRST
    word = (word ^ (word >> SHIFTS[1])) * SECOND
    return word ^ (word >> SHIFTS[2])


@kernel
def _share(word):
    """The upper 53 bits, from 0 to below 1."""
    return np.int64(word >> BELOW) * UNIT


@kernel
def _normal(words, edges, densities, numbers):
    """The number of every word: a place in a layer, at once if it lies below the next one too, else
    if it lies below the bell."""
    for n in range(len(words)):
        word = state = words[n]
        while True:
            layer = np.int64(word & LAYER)
            number = _share(word) * edges[layer]
            if number < edges[layer + 1]:
                break
            if layer == 0:
                number = _beyond(state, edges[1])
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
def _beyond(state, tail):
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
    """Either half of a word is a coordinate in the square around the disc."""
    for n in range(len(words)):
        word = state = words[n]
        while True:
            x = (np.int64(word >> HALF) + 0.5) * TWICE - 1.0
            y = (np.int64(word & LOWER) + 0.5) * TWICE - 1.0
            square = x * x + y * y
            if square <= 1.0:
                break
            state += GOLDEN
            word = _mixed(state)
        cosine[n], sine[n] = (x * x - y * y) / square, 2.0 * x * y / square


GREY = 0.5
"""The albedo of a surface of which nothing else is known."""


@dataclass(frozen=True, eq=False)
class Returns:
    """The returns of one scan, one or two echoes a ray."""

    ranges: Floats
    """(echoes, *shape), metres; ``inf`` where nothing returned."""
    origins: Floats
    """(*shape, 3): where every ray began, in the world."""
    directions: Floats
    """(*shape, 3): where it went."""
    told_origins: Floats
    """(*shape, 3): where the sensor takes it to have begun; `origins`, unless it moves unawares."""
    told_directions: Floats
    """(*shape, 3): where the sensor takes it to have gone."""
    intensity: Floats | None = None
    """(echoes, *shape), from 0 to 1; None where no stage gives it."""

    @classmethod
    def of(cls, scan: Scan) -> "Returns":
        """The returns of a clean scan, one echo a ray."""
        directions = scan.directions
        origins = np.broadcast_to(scan.pose.position, directions.shape)
        return cls(scan.ranges.astype(np.float64)[None], origins, directions, origins, directions)

    def points(self, echo: int = 0) -> Floats:
        """Where the sensor takes the returns of one echo to be, (M, 3) in the world, in ray
        order."""
        hit = np.isfinite(self.ranges[echo])
        return self.told_origins[hit] + self.ranges[echo][hit][:, None] * self.told_directions[hit]

    def but(self, **changes: Floats) -> "Returns":
        """The same with other values; an intensity is 0 where nothing returns any more."""
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
    sensor: Sensor
    pose: Pose
    albedo: Floats | None = None
    """(geoms,): what share of light every geom of the model reflects, see `albedo_of`; `GREY` for
    all where None."""

    def cast(self, origins: Floats, directions: Floats) -> Floats:
        """Clean ranges (*shape) of rays that begin at origins (*shape, 3); ``inf`` beyond the
        sensor's range."""
        ranges = np.empty(directions.shape[:-1])
        for group, origin in _by_origin(origins):
            (ranges[group],) = self.engine.cast(
                origin[None], directions[group][None], self.sensor.max_range_m
            )
        return ranges

    def surfaces(self, returns: Returns) -> tuple[Floats, Floats]:
        """Cosine of the angle between ray and normal, and albedo, (*shape) each, of what the rays
        meet first; 0 where that is nothing. Raises ValueError for an engine that cannot tell."""
        hits = getattr(self.engine, "hits", None)
        if hits is None:
            raise ValueError(
                f"noise: {type(self.engine).__name__} does not say what surface a ray meets; use "
                "the engine analytic, or for a map only stages that change ranges"
            )
        cosine, albedo = lit = np.empty((2, *returns.directions.shape[:-1]))
        light = np.empty(0) if self.albedo is None else np.array(self.albedo, float)
        for group, origin in _by_origin(returns.origins):
            directions = returns.directions[group]
            found = hits(origin[None], directions[None], self.sensor.max_range_m)
            rays = directions.reshape(-1, 3)
            here = lit if group is ... else np.empty((2, len(rays)))
            _reflect(
                found.geoms.reshape(-1),
                found.normals.reshape(rays.shape),
                rays,
                light,
                *here.reshape(2, len(rays)),
            )
            if group is not ...:
                cosine[group], albedo[group] = here
        return cosine, albedo


@kernel
def _reflect(geoms, normals, rays, light, cosine, albedo):
    for n in range(len(geoms)):
        cosine[n] = albedo[n] = 0.0
        if geoms[n] >= 0:
            x, y, z = normals[n]
            met = abs(x * rays[n, 0] + y * rays[n, 1] + z * rays[n, 2])
            cosine[n] = met if met > 0.0 else 0.0  # a triangle without area has no normal
            albedo[n] = light[geoms[n]] if len(light) else GREY


def albedo_of(model: mujoco.MjModel) -> Floats:
    """What share of light every geom reflects, (ngeom,): the brightness of its material's colour,
    or of its own without one, by the weights of ITU-R BT.709. Textures are not looked at."""
    red, green, blue, _ = colours(model).T
    return np.clip((0.2126 * red + 0.7152 * green) + 0.0722 * blue, 0.0, 1.0)


def _by_origin(origins: Floats) -> list[tuple[Any, Floats]]:
    """The rays that share an origin, as an index of arrays (*shape), and that origin (3,)."""
    if not any(origins.strides[:-1]):  # broadcast from one, as `Returns.of` has it
        return [(..., origins[(0,) * (origins.ndim - 1)])]
    flat = origins.reshape(-1, 3)
    # rays in a row mostly share theirs: only the first of each such run is sorted
    begins = np.flatnonzero(np.append(True, (flat[1:] != flat[:-1]).any(axis=1)))
    places, which = np.unique(flat[begins], axis=0, return_inverse=True)
    number = np.repeat(which.reshape(-1), np.diff(begins, append=len(flat)))
    return list(zip(grouped(number.reshape(origins.shape[:-1])), places, strict=True))


def grouped(number: Ints) -> list[Any]:
    """Indices of arrays (*shape), of those of each number (*shape) that occurs, in rising order."""
    order = np.argsort(number, axis=None, kind="stable")
    begins = np.flatnonzero(np.diff(number.reshape(-1)[order])) + 1
    return [np.unravel_index(part, number.shape) for part in np.split(order, begins)]


class Fault(Checked):
    """What most stages are: one that changes returns, and moves none."""

    order: ClassVar[int] = 2

    def bound_m(self, max_range_m: float) -> float:
        """See `Stage.bound_m`."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Intensity(Fault):
    """Intensity as albedo × cosine of the angle of incidence (Lambert), freed of the range as
    sensors' own is, with normal noise of `sigma`, from 0 to 1."""

    sigma: float = number(0.0, least=0, most=1)
    """Standard deviation of the noise."""

    def apply(self, returns: Returns, view: View, *, rng: Generator) -> Returns:
        """See `Stage.apply`."""
        cosine, albedo = view.surfaces(returns)
        noise = self.sigma * normal(returns.ranges.shape, rng=rng)
        return returns.but(intensity=np.clip(albedo * cosine + noise, 0.0, 1.0))
