"""Engines: intersect rays with a world. One file an engine; each fills `Engine`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, Self

from lidarsim.registry import Registry

if TYPE_CHECKING:  # the command line asks for the names, and must not load NumPy for that
    import mujoco
    from numpy.typing import ArrayLike

    from lidarsim.grid import Floats


class Caster(Protocol):
    """An object that intersects rays with a world or a map. It serves one thread at a time."""

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """Find the first surface along rays, for P poses at once.

        A pose's result does not depend on the others. From inside a solid, a ray meets the surface
        where it comes out. Planes are seen from their front, +z, and within their half sizes where
        these are not 0.

        Args:
            origins: (P, 3), metres, in the world. Those that are not finite meet nothing.
            directions: (P, *shape, 3), unit vectors in the world. Lengths within a millionth of 1
                count as 1; other vectors meet nothing.
            max_range_m: How far rays go, metres.

        Returns:
            (P, *shape), metres along the rays; ``inf`` where nothing is met within the range.

        Raises:
            ValueError: By our engines, if arrays have other shapes, or the range is negative or
                NaN.
        """
        ...


class Engine(Caster, Protocol):
    """A caster of one compiled world.

    A method `hits`, see `AnalyticEngine.hits`, is optional. It tells which surface every ray met;
    stages of noise that need surfaces call it."""

    @classmethod
    def of(cls, model: mujoco.MjModel, data: mujoco.MjData | None = None) -> Self:
        """Make the engine of a compiled world.

        Geoms whose material, or whose own colour without one, has alpha 0 are invisible.
        `lidarsim.solids` refuses a world that our engines cannot cast when it reads it.

        Args:
            model: The world; not changed.
            data: Where bodies are, forwarded by MuJoCo; not changed. The reference configuration if
                None.

        Returns:
            The engine.
        """
        ...


EngineFactory = Callable[["mujoco.MjModel", "mujoco.MjData"], Engine]
"""A function that makes an engine of a world, such as `Engine.of`."""

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
