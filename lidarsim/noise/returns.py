"""What stages pass on, what they may ask of the world, and how bright a return is."""

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import mujoco
import numpy as np
from numpy.random import Generator

from lidarsim.engines import Caster
from lidarsim.grid import Floats, Ints
from lidarsim.jit import kernel
from lidarsim.noise.chance import normal
from lidarsim.parameters import Checked, number
from lidarsim.pose import Pose
from lidarsim.scan import Scan
from lidarsim.sensors import Sensor
from lidarsim.solids.model import colours

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
