"""The voxel grid: its shape, its voxel, and the way between world metres and indices."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, kw_only=True)
class GridSpec:
    """An axis-aligned grid of cubic voxels, x y z in that order, z up.

    Voxel (i, j, k) of a grid with least corner `origin` holds the points p for which
    ``floor((p - origin) / voxel_m)`` is (i, j, k), in float64; its centre is
    ``origin + (i + 0.5, j + 0.5, k + 0.5) * voxel_m``.
    """

    shape: tuple[int, int, int] = (80, 80, 40)
    """Voxels along x, y and z."""
    voxel_m: float = 0.2
    """Edge of a voxel, metres."""
    truncation_m: float = 2.0
    """Distance at which distance fields on this grid saturate, metres."""

    def __post_init__(self) -> None:
        if len(self.shape) != 3 or not all(np.isfinite(n) and n >= 1 and int(n) == n for n in self.shape):
            raise ValueError(f"shape = {self.shape} must be three whole numbers of at least 1")
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        for name in ("voxel_m", "truncation_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} = {value} must be a positive length in metres")
        if self.truncation_m > 1000 * self.voxel_m:
            raise ValueError(
                f"truncation_m = {self.truncation_m}: expected a thousand voxels of {self.voxel_m} m at most"
            )

    @property
    def extent_m(self) -> NDArray[np.float64]:
        """Edge lengths of the whole grid, (3,), metres."""
        return np.array(self.shape, dtype=np.float64) * self.voxel_m

    def origin_at(self, position: ArrayLike) -> NDArray[np.float64]:
        """Least corner, (3,) in the world, of the grid centred on `position` (3,)."""
        return np.asarray(position, dtype=np.float64) - self.extent_m / 2

    def index(self, points: ArrayLike, origin: ArrayLike) -> NDArray[np.int64]:
        """Indices (..., 3) of the voxels that hold `points` (..., 3), world metres; they may lie outside the grid."""
        relative = np.asarray(points, dtype=np.float64) - np.asarray(origin, dtype=np.float64)
        return np.floor(relative / self.voxel_m).astype(np.int64)

    def centres(self, origin: ArrayLike) -> NDArray[np.float64]:
        """Voxel centres, (*shape, 3), world metres."""
        steps = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in self.shape), indexing="ij"), axis=-1)
        return np.asarray(origin, dtype=np.float64) + steps * self.voxel_m
