"""What every kind of world has in common."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np

from lidarsim.elementary import sin_cos
from scenegen.limits import MOST_DRAWN_SOLIDS

Range = tuple[float, float]
"""A lower and an upper bound, both included; worlds or solids draw from between."""


@dataclass(frozen=True, kw_only=True)
class WorldKind(ABC):
    """Parameters of a kind of world, and how to draw one.

    Worlds span x and y from 0 to `size_m`; the ground is z = 0.
    """

    version: ClassVar[int]
    """Of the preset: raised whenever the same parameters would give other worlds, or the defaults change."""
    crowding: ClassVar[tuple[str, ...]]
    """The parameters to lower when worlds are too crowded to fly through, or to raise when they are too empty."""
    flight_defaults: ClassVar[dict[str, object]] = {}
    """Fields of `scenegen.flight.Flight` in which this kind's preset differs from the general default."""
    accept_defaults: ClassVar[dict[str, object]] = {}
    """The same for `scenegen.recipe.Acceptance`."""

    size_m: tuple[float, float, float] = (40.0, 40.0, 10.0)
    """Extent of the world along x, y and z, metres; z is how high floating solids may have their centres."""
    ground: bool = False
    """Whether there is a floor: a slab over the world's plan with its top at z = 0."""
    ground_m: float = 0.2
    """Thickness of that slab, metres."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, str):
                continue
            numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
            if not np.isfinite(numbers).all():
                raise ValueError(f"{name} = {value}: expected finite numbers")
            if isinstance(value, tuple) and len(value) == 2 and not 0 <= value[0] <= value[1]:
                raise ValueError(f"{name} = {list(value)}: expected [low, high] with 0 <= low <= high")
            if name.endswith("_share") and not 0 <= value <= 1:
                raise ValueError(f"{name} = {value}: expected a share from 0 to 1")
            if name.endswith("density") and numbers[-1] * self.size_m[0] * self.size_m[1] > MOST_DRAWN_SOLIDS:
                raise ValueError(
                    f"{name} = {value}: more than {MOST_DRAWN_SOLIDS} of them in a world; lower it or size_m"
                )
            if name.endswith("_m") and not (numbers > 0).all():
                raise ValueError(f"{name} = {value}: expected lengths above 0, in metres")

    @abstractmethod
    def add_to(self, spec: mujoco.MjSpec, *, rng: np.random.Generator) -> None:
        """Draw one world and add its solids to `spec`."""

    def add_ground(self, spec: mujoco.MjSpec) -> None:
        """Add the floor, where there is one."""
        if self.ground:
            x, y, _ = self.size_m
            half, centre = (x / 2, y / 2, self.ground_m / 2), (x / 2, y / 2, -self.ground_m / 2)
            add_geom(spec, mujoco.mjtGeom.mjGEOM_BOX, half, centre, rgba=(0.55, 0.53, 0.5, 1.0))


def add_geom(spec: mujoco.MjSpec, shape: mujoco.mjtGeom, size: Any, position: Any, **more: Any) -> None:
    """Add one solid straight under the world body, where mj_multiRay is fastest. `more` may give `quat` and `rgba`."""
    spec.worldbody.add_geom(type=shape, size=size, pos=position, **more)


def yaw_quaternion(yaw_rad: float) -> tuple[float, float, float, float]:
    """A turn about the vertical as a quaternion, w x y z."""
    sine, cosine = sin_cos(yaw_rad / 2)
    return (float(cosine), 0.0, 0.0, float(sine))
