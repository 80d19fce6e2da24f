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
def _shares(spans, first, edge):
    """The part of each voxel, along one axis, that lies in each of the map's voxels that it
    overlaps: (count, most of them)."""
    found = np.zeros((len(spans), math.ceil(edge) + 1))
    for n in range(len(spans)):
        low, high = first + n * edge, first + (n + 1) * edge
        for number in range(spans[n, 0], spans[n, 1]):
            part = min(high, number + 1.0) - max(low, float(number))
            found[n, number - spans[n, 0]] = max(part, 0.0) / edge
    return found


@kernel
def _resample(states, first, edge, voxel_m, occupancy, known):
    """Bits of states are joined over the map's columns that a column of voxels overlaps; volumes
    are summed where these do not tell."""
    nx, ny, nz = occupancy.shape
    xs = _axis(first[0], edge, voxel_m, nx, states.shape[0])
    ys = _axis(first[1], edge, voxel_m, ny, states.shape[1])
    zs = _axis(first[2], edge, voxel_m, nz, states.shape[2])
    in_x, in_y, in_z = (
        _shares(xs, first[0], edge),
        _shares(ys, first[1], edge),
        _shares(zs, first[2], edge),
    )
    low, high = zs[0, 0], zs[nz - 1, 1]
    any_of, all_of = np.empty(high - low, np.uint8), np.empty(high - low, np.uint8)
    for i in range(nx):
        for j in range(ny):
            any_of[:], all_of[:] = UNKNOWN, FREE
            for a in range(xs[i, 0], xs[i, 1]):
                for b in range(ys[j, 0], ys[j, 1]):
                    column = states[a, b, low:high]
                    for c in range(high - low):
                        any_of[c] |= column[c]
                        all_of[c] &= column[c]
            begin, end = 0, high - low
            while begin < end and any_of[begin] == UNKNOWN:
                begin += 1
            while begin < end and any_of[end - 1] == UNKNOWN:
                end -= 1
            inside = in_x[i].sum() * in_y[j].sum()
            for k in range(nz):
                if zs[k, 1] - low <= begin or zs[k, 0] - low >= end:
                    continue
                found, free = UNKNOWN, FREE
                for c in range(zs[k, 0] - low, zs[k, 1] - low):
                    found |= any_of[c]
                    free &= all_of[c]
                occupancy[i, j, k] = found >= OCCUPIED
                known[i, j, k] = found != UNKNOWN
                if found == FREE and not (free and inside * in_z[k].sum() > LEAST_KNOWN):
                    part = 0.0
                    for a in range(xs[i, 0], xs[i, 1]):
                        for b in range(ys[j, 0], ys[j, 1]):
                            share = in_x[i, a - xs[i, 0]] * in_y[j, b - ys[j, 0]]
                            for c in range(zs[k, 0], zs[k, 1]):
                                part += share * in_z[k, c - zs[k, 0]] * (states[a, b, c] == FREE)
                    known[i, j, k] = part >= LEAST_KNOWN - 1e-9
