"""The voxel grid: its shape, its voxel, and the way between world metres and indices."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.parameters import check, number

Mask = NDArray[np.bool_]
"""Which voxels of a grid, or which of anything."""
Field = NDArray[np.float32]
"""A number for every voxel of a grid, or every ray of a scan: distances, probabilities, ranges."""
Floats = NDArray[np.float64]
"""Positions, directions, lengths, figures."""
Ints = NDArray[np.int64]
"""Indices and counts."""
Vector = tuple[float, float, float]
"""x, y and z."""
MAX_EDGE = 8192
"""Voxels along an axis: distances are computed on rows of whole slices, padded by the
truncation."""
MAX_REACH = 1000
"""Voxels in the truncation: its square, counted in voxels, then fits 32 bits twice over."""


def finite(name: str, values: ArrayLike, size: int) -> Floats:
    """Copy a vector and check it.

    Args:
        name: The vector's name, for the message.
        values: The vector, (size,).
        size: How many numbers it must have.

    Returns:
        The copy, (size,).

    Raises:
        ValueError: If there are not `size` numbers, or some are not finite.
    """
    value = np.array(values, float)
    if value.shape != (size,) or not np.isfinite(value).all():
        raise ValueError(f"{name} = {value} must be {size} finite numbers")
    return value


def iou(first: Mask, second: Mask) -> float:
    """Compute intersection over union of two masks.

    Args:
        first: A mask of any shape.
        second: A mask of the same shape.

    Returns:
        From 0 to 1; 1 if both are empty.
    """
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else 1.0


def rays_of(origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> tuple[Floats, Floats]:
    """Check and copy the arguments of `lidarsim.engines.Engine.cast`.

    Args:
        origins: (P, 3), metres, in the world.
        directions: (P, *shape, 3), in the world.
        max_range_m: How far rays go, metres.

    Returns:
        Copies of origins and directions in C order, which kernels need.

    Raises:
        ValueError: If shapes differ from these, or the range is negative or NaN.
    """
    starts, rays = np.array(origins, float, order="C"), np.array(directions, float, order="C")
    if starts.shape[1:] != (3,) or rays.shape != (len(starts), *rays.shape[1:-1], 3):
        raise ValueError(
            f"origins of shape {starts.shape} and directions of {rays.shape}; expected (P, 3) and "
            f"(P, *shape, 3)"
        )
    # not `< 0`, so that NaN is refused, too
    if not max_range_m >= 0:
        raise ValueError(f"max_range_m = {max_range_m}: expected metres from 0 on")
    return starts, rays


@dataclass(frozen=True, kw_only=True)
class GridSpec:
    """An axis-aligned grid of cubic voxels, x y z in that order, z up.

    Voxel (i, j, k) of a grid with least corner `origin` holds the points p for which ``floor((p -
    origin) / voxel_m)`` is (i, j, k), in float64; its centre is ``origin + (i + 0.5, j + 0.5, k +
    0.5) * voxel_m``.
    """

    shape: tuple[int, int, int] = number((80, 80, 40), minimum=1, maximum=MAX_EDGE)
    """Voxels along x, y and z."""
    voxel_m: float = number(0.2, minimum=1e-3, maximum=1e3)
    """Edge of a voxel, metres."""
    truncation_m: float = number(2.0, above=0)
    """Distance at which distance fields on this grid saturate, metres."""
    hollow: bool = False
    """Whether the truth holds only surfaces: voxels wholly inside one solid are not occupied."""

    def __post_init__(self) -> None:
        check(self)
        if self.truncation_m > MAX_REACH * self.voxel_m:
            raise ValueError(
                f"truncation_m = {self.truncation_m}: expected {MAX_REACH} voxels of "
                f"{self.voxel_m} m at most"
            )

    @property
    def extent_m(self) -> Floats:
        """Edge lengths of the whole grid, (3,), metres."""
        return np.array(self.shape, float) * self.voxel_m

    def origin_at(self, position: ArrayLike) -> Floats:
        """Compute the least corner (3,), in the world, of the grid centred on `position` (3,),
        metres."""
        return np.asarray(position, float) - self.extent_m / 2

    def index(self, points: ArrayLike, origin: ArrayLike) -> Ints:
        """Compute the indices of the voxels that hold points.

        Args:
            points: (..., 3), metres, in the world.
            origin: (3,): the grid's least corner in the world, metres.

        Returns:
            (..., 3); they may lie outside the grid.
        """
        relative = np.asarray(points, float) - np.asarray(origin, float)
        # floor before the conversion, which would round negative numbers towards 0
        return np.floor(relative / self.voxel_m).astype(np.int64)

    def centres(self, origin: ArrayLike) -> Floats:
        """Compute voxel centres (*shape, 3), metres, in the world."""
        steps = np.stack(
            np.meshgrid(*(np.arange(n) + 0.5 for n in self.shape), indexing="ij"), axis=-1
        )
        return np.asarray(origin, float) + steps * self.voxel_m
