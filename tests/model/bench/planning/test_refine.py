"""Refinement descends on the stated cost: its value and gradient against references, its laws on
real maps."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import RegularGridInterpolator

from lidarsim import GridSpec
from scenegen.model.bench.planner import _cost, refine
from scenegen.model.config import PlanConfig
from scenegen.truth import distance_field

GRID = GridSpec(shape=(20, 16, 12), voxel_m=0.25)


def reference_cost(path, tudf, grid, safety_m, weight):
    """By scipy's linear interpolation, at points moved to the nearest place between voxel
    centres."""
    axes = [(np.arange(n) + 0.5) * grid.voxel_m for n in grid.shape]
    held = np.clip(path[1:-1], *np.transpose([axis[[0, -1]] for axis in axes]))
    lack = np.maximum(0.0, safety_m - RegularGridInterpolator(axes, tudf.astype(float))(held))
    return (np.diff(path, 2, axis=0) ** 2).sum() + weight * (lack**2).sum()


def cost_and_gradient(path, tudf, grid, config):
    slope, settings = np.empty_like(path), (config.safety_m, config.clearance_weight)
    return _cost(path, tudf.astype(np.float32), grid.voxel_m, *settings, slope), slope


@pytest.mark.parametrize("shape", [(20, 16, 12), (5, 2, 7)])
@pytest.mark.parametrize(("safety_m", "weight"), [(0.6, 3.0), (2.5, 0.2)])
def test_cost_and_gradient_are_the_formulas(safety_m, weight, shape, rng):
    """The cost by numpy and scipy; the gradient by central differences of that, ends excepted; of a
    path within the map and beyond it."""
    grid, step = GridSpec(shape=shape, voxel_m=0.25), 1e-6
    tudf = rng.uniform(0.0, 2.0, shape).astype(np.float32)
    path = rng.uniform(-0.5, grid.extent_m + 0.5, (60, 3))
    config = PlanConfig(safety_m=safety_m, clearance_weight=weight)
    cost, gradient = cost_and_gradient(path, tudf, grid, config)
    settings = tudf, grid, safety_m, weight
    assert cost == pytest.approx(reference_cost(path, *settings))
    slopes = [
        reference_cost(path + unit, *settings) - reference_cost(path - unit, *settings)
        for unit in step * np.eye(path.size).reshape(-1, *path.shape)
    ]
    expected = np.reshape(slopes, path.shape) / (2 * step)
    expected[[0, -1]] = 0.0
    assert_allclose(gradient, expected, rtol=1e-6, atol=2e-6)


def test_the_cost_never_rises(rng):
    """Iteration by iteration, and the ends stay; it falls far on crowded maps."""
    falls = []
    for density in (0.002, 0.01, 0.05):
        tudf = distance_field(rng.random(GRID.shape) < density, GRID)
        path = np.linspace([0.6] * 3, [4.4, 3.4, 2.4], 12) + rng.uniform(-0.2, 0.2, (12, 3))
        refined = [refine(path, tudf, GRID, PlanConfig(iterations=n)) for n in range(51)]
        assert_array_equal([one[[0, -1]] for one in refined], [path[[0, -1]]] * 51)
        costs = [cost_and_gradient(one, tudf, GRID, PlanConfig())[0] for one in refined]
        assert (np.diff(costs) <= 0).all()
        falls.append(costs[-1] / costs[0])
    assert max(falls) < 0.7


def test_paths_in_free_space_become_even_and_straight(rng):
    """The only path without second differences between its ends."""
    tudf = np.full(GRID.shape, 2.0, np.float32)
    line = np.linspace([0.5, 0.5, 0.5], [4.5, 3.5, 2.5], 6)
    bent = line + np.pad(rng.uniform(-0.3, 0.3, (4, 3)), ((1, 1), (0, 0)))
    assert_allclose(refine(bent, tudf, GRID, PlanConfig(iterations=2000)), line, atol=1e-5)


def test_waypoints_stay_within_outermost_centres():
    """Pushed against the border, they stop there and still slide along it."""
    grid = GridSpec(shape=(40, 40, 20))
    occupied = np.zeros(grid.shape, bool)
    occupied[10:30, 3:5, :] = True
    line = np.linspace([0.5, 0.3, 2.1], [7.5, 0.3, 2.1], 13)
    config = PlanConfig(safety_m=2.0, clearance_weight=50.0, iterations=200)
    refined = refine(line, distance_field(occupied, grid), grid, config)
    assert refined.min() == 0.1
    assert (refined[:, 1] == 0.1).sum() >= 3
    assert (refined <= grid.extent_m - 0.1).all()
    assert np.ptp(np.diff(refined[:, 0])) > 0
