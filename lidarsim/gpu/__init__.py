"""Many different worlds at once on an NVIDIA GPU, by Warp: rays and voxels. The truth is
`scenegen.truth.gpu`.

The functions that a thread runs are those for the processor, translated: float64, in the same
order, without fused multiplications, so answers have the same bits. Warp's own mode without a GPU
(``device="cpu"``) is one slow thread, and is there for tests.
"""

import ctypes
import importlib.util
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.grid import Floats, rays_of
from lidarsim.solids.shapes import Solids

if TYPE_CHECKING:
    import mujoco


class WarpEngine:
    """Casts the analytic engine's rays on an NVIDIA GPU: an `Engine`.

    One world at a time leaves a GPU idle: `lidarsim.gpu.rays.cast` takes many.
    """

    def __init__(self, solids: Solids, *, device: str = "cuda"):
        """Raises ValueError without Warp, and for a device that is not there."""
        if device.startswith("cuda") and (missing := self.missing()):
            raise ValueError(f"the engine warp {missing}")
        from lidarsim.gpu import rays, worlds  # loads Warp, which no other engine needs

        self._worlds, self._cast = worlds.Worlds([solids], device=device), rays.cast

    @classmethod
    def of(cls, model: "mujoco.MjModel", data: "mujoco.MjData | None" = None) -> Self:
        """As `lidarsim.engines.Engine.of`. Raises ValueError as `solids_of` does, and without a
        GPU."""
        from lidarsim.solids.model import solids_of  # loads MuJoCo

        return cls(solids_of(model, data))

    @staticmethod
    def missing() -> str:
        """What this machine lacks, as the end of a sentence; empty where Warp and a GPU's driver
        are there."""
        if importlib.util.find_spec("warp") is None:
            return "needs NVIDIA Warp; in scenegen's checkout: pip install -e '.[gpu]'"
        try:
            ctypes.CDLL("libcuda.so.1")  # starts nothing, so that workers can still be forked
        except OSError:
            return (
                "needs an NVIDIA GPU, and no driver of one is found here; the engine analytic "
                "gives the same ranges"
            )
        return ""

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """As `lidarsim.engines.Engine.cast`."""
        starts, rays = rays_of(origins, directions, max_range_m)
        poses, count = len(rays), int(np.prod(rays.shape[1:-1]))
        flat, which = rays.reshape(poses, count, 3), np.zeros(poses, dtype=np.int64)
        ranges = self._cast(self._worlds, starts, flat, max_range_m, which=which)
        return ranges.numpy().reshape(rays.shape[:-1])
