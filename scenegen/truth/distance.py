"""Exact truncated Euclidean distance transform of an occupancy grid."""

import math

import numpy as np

from lidarsim.grid import Field, GridSpec, Mask
from lidarsim.jit import kernel


def distance_field(occupancy: Mask, grid: GridSpec) -> Field:
    """The TUDF of `occupancy` (*grid.shape): metres from each voxel's centre to the nearest
    occupied voxel's centre.

    Exactly ``float32(min(voxel_m * sqrt(float64(k)), truncation_m))`` with k the squared distance
    in voxels; 0 where occupied, `truncation_m` everywhere in an empty map. Only occupancy within
    the map counts (the paper's section "Training Data Generation").

    Squared distances are whole numbers, and none beyond the truncation matters, so they fit in a
    byte (for the default grid, 100 at most) and three passes of minima, one an axis, give them
    exactly (Saito and Toriwaki 1994).
    """
    cap, table = lookup(grid)
    # a sum of two capped squares must fit the type
    dtype = np.uint8 if 2 * cap < 256 else np.uint16 if 2 * cap < 65536 else np.uint32
    nx, ny, nz = occupancy.shape
    reach = math.isqrt(cap - 1)  # offsets whose square alone stays below the cap
    line = nz + reach
    steps, run = np.full((nx, ny * nz), cap, dtype), np.empty(ny * nz, dtype)
    row = np.full((ny + 2 * reach) * line, cap, dtype)
    squares, nearest = np.full(ny * line + 2 * reach, cap, dtype), np.empty(ny * line, dtype)
    distance = np.empty(occupancy.shape, np.float32)
    occupied = np.ascontiguousarray(occupancy).view(np.uint8).reshape(steps.shape)
    _transform(occupied, dtype(cap), table, reach, steps, run, row, squares, nearest, distance)
    return distance


def lookup(grid: GridSpec) -> tuple[int, Field]:
    """The squared distance in voxels from which on all is truncated, and the metres (cap + 1,) of
    squares up to it."""
    reach = grid.truncation_m / grid.voxel_m
    cap = math.ceil(reach * reach)
    while cap > 0 and grid.voxel_m * math.sqrt(cap - 1) >= grid.truncation_m:
        cap -= 1
    table = np.minimum(
        grid.voxel_m * np.sqrt(np.arange(cap + 1, dtype=np.float64)), grid.truncation_m
    )
    table[cap] = grid.truncation_m
    return cap, table.astype(np.float32)


@kernel
def _transform(occupied, cap, table, reach, steps, run, row, squares, nearest, distance):
    """Squared distances up to `cap`, one axis after the other, looked up in `table` (cap + 1,).

    All in the type of `cap`, so that a vector register holds many. Lines along z are kept apart by
    a margin of `cap`, and slices surrounded by one, so that a shift along y or z is one shift of a
    whole x-slice. What is filled between is made before: numba takes long to compile that.
    """
    nx, ny, nz = distance.shape
    line = nz + reach
    _steps_along_x(occupied, steps, run, steps.dtype.type(reach + 1))
    for i in range(nx):
        for j in range(ny):
            begin = (reach + j) * line
            _square(steps[i, j * nz : (j + 1) * nz], row[begin : begin + nz], cap)
        _spread(row, squares[reach : reach + ny * line], reach, line)
        _spread(squares, nearest, reach, np.int64(1))  # a literal would be compiled by itself
        for j in range(ny):
            _look_up(nearest[j * line : j * line + nz], table, distance[i, j])


@kernel
def _spread(source, squares, reach, line):
    """Set `squares` (m,) to the least of what lies up to `reach` places of `line` numbers away in
    `source`, which has as many more at either end, plus the places' square."""
    m = len(squares)
    here = source[reach * line :]
    for q in range(m):
        squares[q] = here[q]
    for offset in range(1, reach + 1):
        before, after = source[(reach - offset) * line :], source[(reach + offset) * line :]
        _lower(squares, before[:m], after[:m], squares.dtype.type(offset * offset))


@kernel
def _steps_along_x(occupied, steps, run, most):
    """Set `steps` (nx, m) to the voxels from the nearest occupied one along x, at most `most`; in
    `run` (m,) they are counted."""
    nx, m = steps.shape
    one = steps.dtype.type(1)
    for direction in range(2):
        for p in range(m):
            run[p] = most
        for q in range(nx):
            i = q if direction == 0 else nx - 1 - q
            here, there = steps[i], occupied[i]
            for p in range(m):
                run[p] = steps.dtype.type(
                    min(steps.dtype.type(run[p] + one), most) * steps.dtype.type(one - there[p])
                )
                here[p] = min(here[p], run[p])


@kernel
def _square(steps, squares, cap):
    for q in range(len(steps)):
        squares[q] = min(squares.dtype.type(steps[q] * steps[q]), cap)


@kernel
def _lower(squares, before, after, added):
    for q in range(len(squares)):
        squares[q] = min(squares[q], squares.dtype.type(min(before[q], after[q]) + added))


@kernel
def _look_up(index, table, values):
    for q in range(len(index)):
        values[q] = table[index[q]]
