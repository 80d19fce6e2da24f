"""Refinement: gradient descent that smooths a path and pushes it away from obstacles by a distance
field."""

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.grid import Field, Floats, GridSpec
from lidarsim.jit import kernel
from scenegen.model.config import PlanConfig
from scenegen.model.evaluation.planning.astar import checked

FIRST_STEP = 1.0
"""Length of the first step tried, in gradients; later ones begin at the last accepted one,
lengthened."""
SHRINK = 0.5
"""Factor by which a step that is not accepted is shortened, and by whose inverse the next is
lengthened."""
ARMIJO = 0.1
"""Share of the decrease promised by the gradient that a step must bring; small ones let steps
overshoot."""
SHORTEST_STEP = 1e-12
"""Steps shorter than this, in gradients, are not tried: the path stands at a minimum or on a kink
of the field."""


def refine(waypoints: ArrayLike, tudf: Field, grid: GridSpec, config: PlanConfig) -> Floats:
    """The path (n, 3) after gradient descent on `_cost` from `waypoints` (n, 3), map frame, metres;
    ends stay.

    The paper's section "Planning Evaluation", whose optimizer is not told; here each of
    `config.iterations` steps is projected onto the box of the map's voxel centres, where the field
    is interpolated and never extrapolated, and shortened until it brings Armijo's decrease, so that
    the cost never rises. Ends early where no step does.

    `tudf` (*grid.shape) is the predicted distance, metres.
    """
    return _descend(
        np.ascontiguousarray(waypoints, float),
        checked(tudf, "tudf", grid, np.float32),
        grid.voxel_m,
        config.safety_m,
        config.clearance_weight,
        config.iterations,
    )


@kernel
def field_at(tudf, x, y, z, voxel_m):
    """The field at a point of the map, metres, and its gradient there: (value, d/dx, d/dy,
    d/dz)."""
    nx, ny, nz = tudf.shape
    i, u, in_x = _cell(x, voxel_m, nx)
    j, v, in_y = _cell(y, voxel_m, ny)
    k, w, in_z = _cell(z, voxel_m, nz)
    p, q, r = min(i + 1, nx - 1), min(j + 1, ny - 1), min(k + 1, nz - 1)
    a, b = np.float64(tudf[i, j, k]), np.float64(tudf[i, j, r])
    c, d = np.float64(tudf[i, q, k]), np.float64(tudf[i, q, r])
    e, f = np.float64(tudf[p, j, k]), np.float64(tudf[p, j, r])
    g, h = np.float64(tudf[p, q, k]), np.float64(tudf[p, q, r])
    ab, cd, ef, gh = a + w * (b - a), c + w * (d - c), e + w * (f - e), g + w * (h - g)
    low, high = ab + v * (cd - ab), ef + v * (gh - ef)
    by_x = high - low
    by_y = (1.0 - u) * (cd - ab) + u * (gh - ef)
    by_z = (1.0 - u) * ((1.0 - v) * (b - a) + v * (d - c)) + u * ((1.0 - v) * (f - e) + v * (h - g))
    return low + u * by_x, in_x * by_x / voxel_m, in_y * by_y / voxel_m, in_z * by_z / voxel_m


@kernel
def _cell(at, voxel_m, count):
    """The voxel whose centre comes last before `at` along one axis, the way from there to the next
    centre, 0 to 1, and whether (1.0 or 0.0) the field changes with `at`: it does not beyond the
    outermost centres."""
    steps = at / voxel_m - 0.5
    if steps <= 0.0:
        return 0, 0.0, 1.0 if steps == 0.0 else 0.0
    if steps >= count - 1.0:
        last = max(count - 2, 0)
        return last, min(count - 1.0, 1.0), 1.0 if steps == count - 1.0 else 0.0
    whole = int(steps)
    return whole, steps - whole, 1.0


@kernel
def _cost(path, tudf, voxel_m, safety_m, weight, slope):
    """J = sum |p[i+1] - 2 p[i] + p[i-1]|^2 + lambda_c sum max(0, d_s - D(p[i]))^2, m^2, over the
    waypoints between the ends (the paper's section "Planning Evaluation"). D is `field_at`'s.

    Its gradient is written to `slope` (n, 3), metres; 0 at the ends. On a kink of the interpolated
    field, it is that of one side.
    """
    total = 0.0
    slope[:] = 0.0
    for i in range(1, len(path) - 1):
        for axis in range(3):
            bend = path[i + 1, axis] - 2.0 * path[i, axis] + path[i - 1, axis]
            total += bend * bend
            slope[i - 1, axis] += 2.0 * bend
            slope[i, axis] -= 4.0 * bend
            slope[i + 1, axis] += 2.0 * bend
        value, by_x, by_y, by_z = field_at(tudf, path[i, 0], path[i, 1], path[i, 2], voxel_m)
        lack = max(safety_m - value, 0.0)
        total += weight * lack * lack
        push = -2.0 * weight * lack
        slope[i, 0] += push * by_x
        slope[i, 1] += push * by_y
        slope[i, 2] += push * by_z
    slope[0] = 0.0
    slope[-1] = 0.0
    return total


@kernel
def _descend(path, tudf, voxel_m, safety_m, weight, iterations):
    """Projected gradient descent (Bertsekas 1976): a step t to p' must bring ARMIJO / t * |p' -
    p|^2 at least."""
    path = path.copy()
    slope, ahead, trial = np.empty_like(path), np.empty_like(path), path.copy()
    here = _cost(path, tudf, voxel_m, safety_m, weight, slope)
    step = FIRST_STEP * SHRINK
    for _ in range(iterations):
        step /= SHRINK
        while True:
            moved = 0.0
            for i in range(1, len(path) - 1):
                for axis in range(3):
                    high = (tudf.shape[axis] - 0.5) * voxel_m
                    trial[i, axis] = min(
                        max(path[i, axis] - step * slope[i, axis], 0.5 * voxel_m), high
                    )
                    moved += (trial[i, axis] - path[i, axis]) ** 2
            if moved == 0.0:
                return path
            there = _cost(trial, tudf, voxel_m, safety_m, weight, ahead)
            if there <= here - ARMIJO / step * moved:
                break
            step *= SHRINK
            if step < SHORTEST_STEP:
                return path
        path, trial, slope, ahead = trial, path, ahead, slope
        here = there
    return path
