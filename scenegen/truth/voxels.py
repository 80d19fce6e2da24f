"""A map of voxels, resampled into a sample's grid: what is occupied there, and what is known."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.engines.voxels import FREE, OCCUPIED, VoxelMap
from lidarsim.grid import GridSpec
from lidarsim.jit import kernel

LEAST_OVERLAP_M = 1e-6
"""Voxels that overlap less than this along an axis only touch: rounding is less."""
LEAST_KNOWN = 0.5
"""The share of a voxel's volume that must be free in the map for the voxel to be known as free."""


def resample(
    voxels: VoxelMap, grid: GridSpec, origin: ArrayLike
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Occupancy and known space, both (*grid.shape), of the grid whose least corner is `origin`
    (3,), world metres.

    A voxel is occupied where it overlaps an occupied voxel of the map, whatever their sizes, so
    that every return of a `VoxelEngine` lies in an occupied voxel. It is known where it is
    occupied, or where at least half of its volume is free in the map.
    """
    occupancy = np.zeros(grid.shape, dtype=np.bool_)
    known = np.zeros(grid.shape, dtype=np.bool_)
    first = (np.asarray(origin, dtype=np.float64) - voxels.origin) / voxels.voxel_m
    _resample(voxels.states, first, grid.voxel_m / voxels.voxel_m, voxels.voxel_m, occupancy, known)
    return occupancy, known


@kernel
def _axis(first, edge, voxel_m, count, most):
    """For each of `count` voxels of `edge` map voxels from `first` on: the map's voxels, from and
    up to, that it overlaps, (count, 2), at most `most` of them."""
    found = np.zeros((count, 2), np.int64)
    slack = LEAST_OVERLAP_M / voxel_m
    for n in range(count):
        low, high = first + n * edge, first + (n + 1) * edge
        begin, end = math.floor(low + slack), math.ceil(high - slack)
        found[n, 0] = int(min(max(begin, 0.0), float(most)))
        found[n, 1] = int(min(max(end, 0.0), float(most)))
    return found


@kernel
def _share(number, first, edge, n):
    """The part of voxel n, along one axis, that lies in the map's voxel `number`."""
    low, high = first + n * edge, first + (n + 1) * edge
    return max(min(high, number + 1.0) - max(low, float(number)), 0.0) / edge


@kernel
def _resample(states, first, edge, voxel_m, occupancy, known):
    nx, ny, nz = occupancy.shape
    xs = _axis(first[0], edge, voxel_m, nx, states.shape[0])
    ys = _axis(first[1], edge, voxel_m, ny, states.shape[1])
    zs = _axis(first[2], edge, voxel_m, nz, states.shape[2])
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                occupied, free = False, 0.0
                for a in range(xs[i, 0], xs[i, 1]):
                    for b in range(ys[j, 0], ys[j, 1]):
                        for c in range(zs[k, 0], zs[k, 1]):
                            state = states[a, b, c]
                            if state == OCCUPIED:
                                occupied = True
                                break
                            if state == FREE:
                                free += (
                                    _share(a, first[0], edge, i)
                                    * _share(b, first[1], edge, j)
                                    * _share(c, first[2], edge, k)
                                )
                        if occupied:
                            break
                    if occupied:
                        break
                occupancy[i, j, k] = occupied
                known[i, j, k] = occupied or free >= LEAST_KNOWN - 1e-9
