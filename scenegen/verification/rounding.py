"""Voxels of older scans that rounding decides: generator 1 took the rays' directions from its
processor's sines."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, ObservedGrid, Pose, Scan, voxelize

NUDGE_M = 1e-13
"""More than the last bits of a direction move a point of a ray of some ten metres."""


def as_rounded(
    seen: ObservedGrid, scan: Scan, grid: GridSpec, stored: Mapping[str, NDArray[Any]]
) -> ObservedGrid:
    """`seen`, which is what `scan` gives, with the `stored` value of every voxel of `observed` and
    `free` that changes when all rays move by `NUDGE_M` along some diagonal of the grid."""
    observed, free = stored["observed"], stored.get("free", seen.free)
    if np.array_equal(observed, seen.observed) and np.array_equal(free, seen.free):
        return seen
    open_observed, open_free = np.zeros(grid.shape, np.bool_), np.zeros(grid.shape, np.bool_)
    for signs in itertools.product((-NUDGE_M, NUDGE_M), repeat=3):
        pose = Pose(scan.pose.position + signs, scan.pose.quaternion)
        moved = voxelize(Scan(scan.ranges, pose, scan.lidar), grid, seen.origin)
        open_observed |= moved.observed != seen.observed
        open_free |= moved.free != seen.free
    return ObservedGrid(
        np.where(open_observed, observed, seen.observed),
        np.where(open_free, free, seen.free),
        seen.origin,
    )
