"""Voxels of older scans that rounding decides: generator 1 took the rays' directions from its processor's sines."""

import itertools

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, ObservedGrid, Pose, Scan, voxelize

NUDGE_M = 1e-13
"""More than the last bits of a direction move a point of a ray of some ten metres."""


def undecided(scan: Scan, grid: GridSpec, origin: NDArray[np.float64]) -> ObservedGrid:
    """Which voxels of `observed` and `free` change when all rays move by `NUDGE_M` along some diagonal of the grid."""
    seen = voxelize(scan, grid, origin)
    observed, free = np.zeros(grid.shape, np.bool_), np.zeros(grid.shape, np.bool_)
    for signs in itertools.product((-NUDGE_M, NUDGE_M), repeat=3):
        pose = Pose(scan.pose.position + signs, scan.pose.quaternion)
        moved = voxelize(Scan(scan.ranges, pose, scan.lidar), grid, origin)
        observed |= moved.observed != seen.observed
        free |= moved.free != seen.free
    return ObservedGrid(observed, free, origin)
