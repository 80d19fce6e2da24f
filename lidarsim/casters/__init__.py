"""Engines that cast rays. One file an engine; each fills the `Caster` protocol."""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.casters.mujoco import MujocoCaster


class Caster(Protocol):
    """Anything that knows one world and can intersect rays with it."""

    def cast(self, position: ArrayLike, directions: ArrayLike, max_range_m: float) -> NDArray[np.float64]:
        """Distance in metres along each unit vector of `directions` (..., 3) from `position` (3,), both in the world
        frame, to the first surface; shape (...), ``inf`` where there is none within `max_range_m`."""
        ...


__all__ = ["Caster", "MujocoCaster"]
