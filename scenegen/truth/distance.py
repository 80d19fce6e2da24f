"""Exact truncated Euclidean distance transform of an occupancy grid."""

import math

import numpy as np

from lidarsim.grid import Field, GridSpec, Mask
from lidarsim.jit import kernel


def distance_field(occupancy: Mask, grid: GridSpec) -> Field:
    """Compute the truncated unsigned distance field (TUDF) of an occupancy grid.

    Only occupancy within the map counts (the paper's section "Training Data Generation"). Squared
    distances are whole numbers, and none beyond the truncation matters, so they fit in a byte (for
    the default grid, 100 at most), and three passes of minima, one an axis, give them exactly
    (Saito and Toriwaki 1994).

    Args:
        occupancy: (*grid.shape).
        grid: Its voxel and truncation.

    Returns:
        (*grid.shape): metres from each voxel's centre to the nearest occupied voxel's centre,
        exactly ``float32(min(voxel_m * sqrt(float64(k)), truncation_m))`` with k the squared
        distance in voxels; 0 where occupied, `truncation_m` everywhere in an empty map.
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
    """Tabulate the metres of squared distances.

    Returns the squared distance in voxels from which on all is truncated, the cap, and the metres
    (cap + 1,) of squares up to it."""
    reach = grid.truncation_m / grid.voxel_m
    cap = math.ceil(reach * reach)
    # rounding of the quotient may have made the cap one too large
    while cap > 0 and grid.voxel_m * math.sqrt(cap - 1) >= grid.truncation_m:
        cap -= 1
    table = np.minimum(
        grid.voxel_m * np.sqrt(np.arange(cap + 1, dtype=np.float64)), grid.truncation_m
    )
    # exact, also if the truncation is no root of a whole number
    table[cap] = grid.truncation_m
    return cap, table.astype(np.float32)


@kernel
def _transform(occupied, cap, table, reach, steps, run, row, squares, nearest, distance):
    """Compute squared distances up to `cap`, one axis after the other, and look them up in `table`.

    All numbers have the type of `cap`, so that a vector register holds many. Lines along z are kept
    apart by a margin of `cap`, and slices surrounded by one, so that a shift along y or z is one
    shift of a whole x-slice. Work arrays come from the caller: numba takes long to compile their
    creation."""
    nx, ny, nz = distance.shape
    line = nz + reach
    # capped at reach + 1, so that the square fits the type and is cut by `cap` below
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
    """Set `squares` (m,) to the least of `source` up to `reach` places away plus the places'
    square.

    A place is `line` numbers wide; `source` has `reach` more places at either end."""
    m = len(squares)
    middle = source[reach * line :]
    for q in range(m):
        squares[q] = middle[q]
    for offset in range(1, reach + 1):
        # both sides in one pass over memory
        before, after = source[(reach - offset) * line :], source[(reach + offset) * line :]
        _lower(squares, before[:m], after[:m], squares.dtype.type(offset * offset))


@kernel
def _steps_along_x(occupied, steps, run, cap):
    """Set `steps` (nx, m) to the voxels from the nearest occupied one along x, at most `cap`; `run`
    (m,) counts them."""
    nx, m = steps.shape
    unit = steps.dtype.type(1)
    for direction in range(2):
        for p in range(m):
            run[p] = cap
        for q in range(nx):
            i = q if direction == 0 else nx - 1 - q
            row, filled = steps[i], occupied[i]
            for p in range(m):
                # a product instead of a branch, so that the loop is vectorized
                run[p] = steps.dtype.type(
                    min(steps.dtype.type(run[p] + unit), cap) * steps.dtype.type(unit - filled[p])
                )
                row[p] = min(row[p], run[p])


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
