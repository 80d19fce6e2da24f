"""A map of voxels, resampled into a sample's grid: what is occupied there, and what is known."""

import math

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelMap
from lidarsim.grid import GridSpec, Mask
from lidarsim.jit import kernel

LEAST_OVERLAP_M = 1e-6
"""Voxels that overlap less than this along an axis only touch: rounding is less."""
LEAST_KNOWN = 0.5
"""The share of a voxel's volume that must be free in the map for the voxel to be known as free."""


def resample(voxels: VoxelMap, grid: GridSpec, origin: ArrayLike) -> tuple[Mask, Mask]:
    """Occupancy and known space, both (*grid.shape), of the grid whose least corner is `origin`
    (3,), world metres.

    A voxel is occupied where it overlaps an occupied voxel of the map, whatever their sizes, so
    that every return of a `VoxelEngine` lies in an occupied voxel. It is known where it is
    occupied, or where at least half of its volume is free in the map.
    """
    occupancy = np.zeros(grid.shape, bool)
    known = np.zeros(grid.shape, bool)
    first = (np.asarray(origin, float) - voxels.origin) / voxels.voxel_m
    states, edge = np.ascontiguousarray(voxels.states), grid.voxel_m / voxels.voxel_m
    _resample(states, first, edge, voxels.voxel_m, occupancy, known)
    return occupancy, known


@kernel
def _axis(first, edge, voxel_m, count, most):
    """For each of `count` voxels of `edge` map voxels from `first` on: the map's voxels, from and
    up to, that it overlaps, (count, 2), at most `most` of them; the part of it, along this
    axis, that lies in each of these; and in all of them."""
    spans, shares = np.zeros((count, 2), np.int64), np.zeros((count, math.ceil(edge) + 1))
    slack = LEAST_OVERLAP_M / voxel_m
    for n in range(count):
        low, high = first + n * edge, first + (n + 1) * edge
        begin, end = math.floor(low + slack), math.ceil(high - slack)
        spans[n, 0] = int(min(max(begin, 0.0), float(most)))
        spans[n, 1] = int(min(max(end, 0.0), float(most)))
        for number in range(spans[n, 0], spans[n, 1]):
            part = min(high, number + 1.0) - max(low, float(number))
            shares[n, number - spans[n, 0]] = max(part, 0.0) / edge
    return spans, shares, shares.sum(axis=1)


@kernel
def _resample(states, first, edge, voxel_m, occupancy, known):
    """Bits of states are joined along x, then y, then z; volumes are summed where these do not
    tell."""
    nx, ny, nz = occupancy.shape
    xs, in_x, all_x = _axis(first[0], edge, voxel_m, nx, states.shape[0])
    ys, in_y, all_y = _axis(first[1], edge, voxel_m, ny, states.shape[1])
    zs, in_z, all_z = _axis(first[2], edge, voxel_m, nz, states.shape[2])
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
            here, there = rows.reshape(-1), states[a, left:right].reshape(-1)
            for c in range(len(here)):  # 1 << state, as a vector register has it
                here[c] |= there[c] + np.uint8(1) + (there[c] >> np.uint8(1))
        for j in range(ny):
            column[:], joined[:] = 0, 0
            for b in range(ys[j, 0] - left, ys[j, 1] - left):
                row = rows[b, low:high]
                for c in range(len(row)):
                    column[c] |= row[c]
            for place in places:
                for k in range(nz):
                    joined[k] |= column[place[k]]
            for k in range(nz):  # what lies beyond the map is unknown
                joined[k] |= all_x[i] * all_y[j] * all_z[k] <= LEAST_KNOWN
            if _tell(joined, occupancy[i, j], known[i, j]) == 0:
                continue
            for k in range(nz):
                if joined[k] == 1 << UNKNOWN | 1 << FREE:
                    part = 0.0
                    for a in range(xs[i, 1] - xs[i, 0]):
                        for b in range(ys[j, 1] - ys[j, 0]):
                            line = states[xs[i, 0] + a, ys[j, 0] + b, zs[k, 0] : zs[k, 1]]
                            share = in_x[i, a] * in_y[j, b]
                            for c in range(len(line)):
                                part += share * in_z[k, c] * (line[c] == FREE)
                    known[i, j, k] = part >= LEAST_KNOWN - 1e-9


@kernel
def _tell(joined, occupied, known):
    """Fill two columns by the states that lie in each voxel; and the number of those that are
    partly free, and else unknown."""
    untold = 0
    for k in range(len(joined)):
        occupied[k] = joined[k] >= 1 << OCCUPIED
        known[k] = joined[k] >= 1 << FREE
        untold += joined[k] == 1 << UNKNOWN | 1 << FREE
    return untold
