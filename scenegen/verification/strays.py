"""How far returns lie from what is there: noise may move them, and no farther than it declares."""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec

SLACK_M = 2e-6
"""What float32 ranges and the slack of `occupancy` add to a bound."""


def count_strays(
    points: NDArray[np.float64],
    occupancy: NDArray[np.bool_],
    grid: GridSpec,
    origin: NDArray[np.float64],
    bound_m: float,
) -> int:
    """How many of the returns `points` (M, 3), in the world, lie in the map and farther than
    `bound_m` from every occupied voxel, and from the map's faces, beyond which a solid may be."""
    inside, most, voxel = points - origin, bound_m + SLACK_M, grid.voxel_m
    extent = np.array(grid.shape) * voxel
    left = inside[((inside >= most) & (inside <= extent - most)).all(axis=1)]
    shape = np.array(grid.shape)
    shells = range(math.ceil(min(most / voxel, max(grid.shape))) + 1)
    for offset in itertools.chain.from_iterable(
        map(_shell, shells)
    ):  # nearest first: few points are left soon
        if not len(left):
            break
        cells = np.floor(left / voxel).astype(np.int64) + offset
        known = ((cells >= 0) & (cells < shape)).all(axis=1)
        gaps = np.maximum(np.maximum(cells * voxel - left, left - (cells + 1) * voxel), 0.0)
        near = known & ((gaps**2).sum(axis=1) <= most * most)
        near[near] = occupancy[tuple(cells[near].T)]
        left = left[~near]
    return len(left)


def _shell(reach: int) -> NDArray[np.int64]:
    """The cells (n, 3) whose greatest coordinate is `reach`, whatever its sign."""
    cells = np.indices((2 * reach + 1,) * 3).reshape(3, -1).T - reach
    return np.asarray(cells[np.abs(cells).max(axis=1) == reach])
