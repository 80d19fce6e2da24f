"""Strays against a slow reference: every point, every occupied cube."""

import numpy as np
import pytest

from lidarsim import GridSpec
from scenegen.verification.rays import SLACK_M, count_strays


@pytest.mark.parametrize("bound_m", [0.0, 0.05, 0.3, 1.1, 50.0])
def test_strays_are_those_of_a_slow_search(bound_m, rng):
    grid, origin = GridSpec(shape=(16, 12, 9), voxel_m=0.2), np.array([1.0, -2.0, 0.5])
    occupancy = rng.random(grid.shape) < 0.01
    extent = np.array(grid.shape) * grid.voxel_m
    points = origin + rng.uniform(-0.5, extent + 0.5, (400, 3))
    corners = origin + np.argwhere(occupancy) * grid.voxel_m
    gaps = np.maximum(corners - points[:, None], points[:, None] - corners - grid.voxel_m).clip(0)
    nearest = np.sqrt((gaps**2).sum(axis=2)).min(axis=1)
    inside = points - origin
    deep = np.minimum(inside, extent - inside).min(axis=1)
    expected = np.count_nonzero((nearest > bound_m + SLACK_M) & (deep >= bound_m + SLACK_M))
    assert count_strays(points, occupancy, grid, origin, bound_m) == expected
    assert (expected > 0) == (bound_m < 0.5)
