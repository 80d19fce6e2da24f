"""Rays through maps of voxels, against points sampled along them."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelEngine, VoxelMap
from tests.lidarsim.engines.test_laws import BAD_RAYS
from tests.lidarsim.reference import unit
from tests.refusals import refuses


def crossed(voxels, start, ray, far_m):
    """Where a ray crosses planes of a map (n + 1,), and the states in between (n,)."""
    distances = [np.array([0.0, far_m])]
    for axis in np.flatnonzero(ray):
        planes = voxels.origin[axis] + voxels.voxel_m * np.arange(voxels.states.shape[axis] + 1)
        distances.append((planes - start[axis]) / ray[axis])
    distances = np.unique(np.clip(np.concatenate(distances), 0.0, far_m))
    middles = start + (distances[:-1] + distances[1:])[:, None] / 2 * ray
    index = np.floor((middles - voxels.origin) / voxels.voxel_m).astype(int)
    inside = ((index >= 0) & (index < voxels.states.shape)).all(axis=1)
    states = np.full(len(middles), UNKNOWN)
    states[inside] = voxels.states[tuple(index[inside].T)]
    return distances, states


@pytest.mark.parametrize("seed", range(3))
def test_rays_return_from_the_first_occupied_voxel(seed):
    """From the middle of their way through it. What is beyond the map is unknown."""
    rng, far_m = np.random.default_rng(seed), 4.0
    states = rng.choice([UNKNOWN, FREE, OCCUPIED], (12, 9, 7), p=[0.2, 0.75, 0.05])
    voxels = VoxelMap(states.astype(np.uint8), 0.25, rng.uniform(-3, 3, 3))
    low, high = voxels.bounds
    starts, rays = rng.uniform(low - 1, high + 1, (200, 3)), unit(rng.normal(size=(200, 3)))
    rays[:6] = np.repeat(np.eye(3), 2, axis=0) * np.tile([1, -1], 3)[:, None]
    query = starts, rays[:, None], far_m
    ranges, unknown = VoxelEngine(voxels).cross(*query)
    for limits in itertools.product((0.0, 0.6, 2.0), (0.2, 0.5, 0.9)):  # a "yes" walks all
        engine = VoxelEngine(voxels)
        assert engine.mostly_known(*query, *limits) == ((unknown > limits[0]).mean() <= limits[1])
        assert_array_equal(engine.cross(*query), (ranges, unknown))
    assert 0 < np.isinf(ranges).sum() < len(starts)
    for start, ray, range_m, unknown_m in zip(starts, rays, ranges, unknown, strict=True):
        distances, crossing = crossed(voxels, start, ray, far_m + 1.0)
        # a corner is cut if the way through it is shorter than 0.1 mm
        met = np.flatnonzero((crossing == OCCUPIED) & (np.diff(distances) > 1e-4))
        first = met[0] if len(met) else len(crossing) - 1
        middle = distances[first : first + 2].mean() if len(met) else np.inf
        assert range_m == pytest.approx(middle if middle <= far_m else np.inf, abs=1e-9)
        lengths = np.diff(np.minimum(distances, far_m))[: first + 1]
        assert unknown_m == pytest.approx(lengths[crossing[: first + 1] == UNKNOWN].sum(), abs=1e-3)


def test_what_is_no_ray_meets_nothing():
    engine = VoxelEngine(VoxelMap(np.full((2, 2, 2), OCCUPIED, np.uint8), 1.0, np.zeros(3)))
    inside, along = np.ones(3), [1.0, 0.0, 0.0]
    assert engine.cast([inside], [[along]], 5.0) == 0.5
    places = [np.nan, 1.0, 1.0], [1.0, 1.0, np.inf]
    for start, ray in [(place, along) for place in places] + [(inside, ray) for ray in BAD_RAYS]:
        assert engine.cross([start], [[ray]], 5.0) == (np.inf, 0.0)
    assert np.isinf(engine.cast([[-9.0, 9.0, 1.0]], [[along]], 50.0)).all()  # past the map
    refuses("two rays of one origin", engine.cast, [inside], [[along]] * 2, 5.0)
