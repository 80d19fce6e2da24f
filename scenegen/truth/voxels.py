"""Resampling of a voxel map into a sample's grid: its occupancy and known space."""

import math

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelMap
from lidarsim.grid import Floats, GridSpec, Ints, Mask
from lidarsim.jit import kernel

MIN_OVERLAP_M = 1e-6
"""Voxels that overlap less than this along an axis only touch, because of rounding."""
MIN_KNOWN = 0.5
"""The share of a voxel's volume that must be free in the map for the voxel to be known as free."""


def resample(voxels: VoxelMap, grid: GridSpec, origin: ArrayLike) -> tuple[Mask, Mask]:
    """Resample a voxel map.

    A voxel is occupied where it overlaps an occupied voxel of the map, whatever their sizes, so
    that every return of a `VoxelEngine` lies in an occupied voxel. It is known where it is
    occupied, or where at least half of its volume is free in the map.

    Args:
        voxels: The map.
        grid: The grid to fill.
        origin: (3,): the grid's least corner in the world, metres.

    Returns:
        Occupancy and known space, both (*grid.shape).
    """
    occupancy = np.zeros(grid.shape, bool)
    known = np.zeros(grid.shape, bool)
    first = (np.asarray(origin, float) - voxels.origin) / voxels.voxel_m
    # `_resample` flattens rows, for which numba wants them without gaps in memory
    states, edge = np.ascontiguousarray(voxels.states), grid.voxel_m / voxels.voxel_m
    # in voxels of the map, as everything from here on
    slack = MIN_OVERLAP_M / voxels.voxel_m
    x, y, z = (
        _axis(*axis, edge, slack) for axis in zip(first, grid.shape, states.shape, strict=True)
    )
    _resample(states, x, y, z, occupancy, known)
    return occupancy, known


def _axis(
    first: float, count: int, limit: int, edge: float, slack: float
) -> tuple[Ints, Floats, Floats]:
    """Match voxels of a grid with a map's along one axis.

    For each of `count` voxels of `edge` map voxels from `first` on, returns the map's voxels that
    it overlaps, from and up to, (count, 2), of `limit` in all; the share of it that lies in each of
    these; and in all of them."""
    low, high = first + np.arange(count) * edge, first + np.arange(1, count + 1) * edge
    ends = np.stack([np.floor(low + slack), np.ceil(high - slack)], axis=1)
    spans = np.clip(ends, 0, limit).astype(np.int64)
    numbers = spans[:, :1] + np.arange(math.ceil(edge) + 1)
    part = np.minimum(high[:, None], numbers + 1.0) - np.maximum(low[:, None], numbers)
    shares = np.where(numbers < spans[:, 1:], np.maximum(part, 0.0) / edge, 0.0)
    return spans, shares, shares.cumsum(axis=1)[:, -1]  # cumsum adds in order; sum would not


@kernel
def _resample(states, x, y, z, occupancy, known):
    """Join bits of states along x, then y, then z; sum volumes where these do not decide.

    Axes are as `_axis` gives them."""
    nx, ny, nz = occupancy.shape
    (xs, in_x, all_x), (ys, in_y, all_y), (zs, in_z, all_z) = x, y, z
    left, right, low, high = ys[0, 0], ys[ny - 1, 1], zs[0, 0], zs[nz - 1, 1]
    rows = np.empty((right - left, states.shape[2]), np.uint8)
    column, joined = np.zeros(high - low + 1, np.uint8), np.empty(nz, np.uint8)
    # where in a column each voxel's part of it lies, padded by a place that is always 0
    places = np.full((in_z.shape[1], nz), high - low, np.uint64)
    for k in range(nz):
        for c in range(zs[k, 0], zs[k, 1]):
            places[c - zs[k, 0], k] = c - low
    for i in range(nx):
        rows[:] = 0
        for a in range(xs[i, 0], xs[i, 1]):
            target, source = rows.reshape(-1), states[a, left:right].reshape(-1)
            for c in range(len(target)):  # 1 << state for 0, 1 and 2, by operations that vectorize
                target[c] |= source[c] + np.uint8(1) + (source[c] >> np.uint8(1))
        for j in range(ny):
            column[:], joined[:] = 0, 0
            for b in range(ys[j, 0] - left, ys[j, 1] - left):
                row = rows[b, low:high]
                for c in range(len(row)):
                    column[c] |= row[c]
            for place in places:
                for k in range(nz):
                    joined[k] |= column[place[k]]
            for k in range(nz):  # space beyond the map is unknown; unknown is 1 << 0
                joined[k] |= all_x[i] * all_y[j] * all_z[k] <= MIN_KNOWN
            if _classify(joined, occupancy[i, j], known[i, j]) == 0:
                continue
            for k in range(nz):
                if joined[k] == 1 << UNKNOWN | 1 << FREE:
                    # no voxel in it is occupied: the free volume decides
                    part = 0.0
                    for a in range(xs[i, 1] - xs[i, 0]):
                        for b in range(ys[j, 1] - ys[j, 0]):
                            line = states[xs[i, 0] + a, ys[j, 0] + b, zs[k, 0] : zs[k, 1]]
                            share = in_x[i, a] * in_y[j, b]
                            for c in range(len(line)):
                                part += share * in_z[k, c] * (line[c] == FREE)
                    # 1e-9: shares that sum to exactly one half may round below it
                    known[i, j, k] = part >= MIN_KNOWN - 1e-9


@kernel
def _classify(joined, occupied, known):
    """Fill two columns by the states in each voxel; count voxels that are partly free, else
    unknown."""
    undecided = 0
    for k in range(len(joined)):
        occupied[k] = joined[k] >= 1 << OCCUPIED
        known[k] = joined[k] >= 1 << FREE
        undecided += joined[k] == 1 << UNKNOWN | 1 << FREE
    return undecided
