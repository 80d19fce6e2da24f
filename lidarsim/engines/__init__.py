"""Engines: what a ray meets in a world, and how far away. One file an engine; each fills
`Engine`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, Self

from lidarsim.registry import Registry

if TYPE_CHECKING:  # the command line asks for the names, and must not load NumPy for that
    import mujoco
    from numpy.typing import ArrayLike

    from lidarsim.grid import Floats


class Caster(Protocol):
    """Anything that can intersect rays with what it knows. It serves one thread at a time."""

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """Metres along the rays to the first surface, for P poses at once.

        `origins` (P, 3) are in the world frame, and so are the unit vectors `directions`
        (P, *shape, 3). The answer has shape (P, *shape), with ``inf`` where nothing is met within
        `max_range_m`. What one pose gives does not depend on the others. From inside a solid, a ray
        meets the surface where it comes out. Planes are seen from their front, +z, and within their
        half sizes where these are not 0. Directions of length 1 to a millionth count as the unit
        vectors along them; other ones (a length of 0, a NaN), and origins that are not finite, meet
        nothing. Engines of ours raise ValueError for arrays of other shapes, and for a range that
        is below 0 or NaN.
        """
        ...


class Engine(Caster, Protocol):
    """A caster that knows one compiled world.

    A method `hits`, see `AnalyticEngine.hits`, is optional. It says what every ray met: stages of
    noise that ask for surfaces need it.
    """

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData | None = None) -> Self:
        """The engine of a compiled world, in its reference configuration, or in that of `data`,
        which MuJoCo has forwarded. Geoms whose material, or whose own colour without one, has alpha
        0 are not there. Neither argument is changed. A world that an engine of ours cannot cast is
        refused when it is read, not here: `lidarsim.solids` knows every shape that is."""
        ...


EngineFactory = Callable[["mujoco.MjModel", "mujoco.MjData"], Engine]
"""What makes an engine of a world: `Engine.of`."""

ENGINES = Registry(
    "engine",
    {
        "analytic": "lidarsim.engines.analytic:AnalyticEngine",
        "mujoco": "lidarsim.engines.mujoco:MujocoEngine",
    },
    needs={
        "of": "a class method: (model, data=None) -> engine",
        "cast": "a method: (origins, directions, max_range_m) -> ranges",
    },
)
"""Engines by name."""
DEFAULT = "analytic"
"""The engine by which datasets are made unless another is named."""
MUJOCO = "mujoco"
"""The engine of datasets whose manifest names none."""
