"""Rays through maps of voxels, against intervals in rational arithmetic."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelEngine, VoxelMap
from tests.lidarsim.engines.test_laws import BAD_RAYS
from tests.lidarsim.reference import passages, unit
from tests.refusals import refuses


@pytest.mark.parametrize("seed", range(3))
def test_rays_return_from_the_first_occupied_voxel(seed):
    """From the middle of their way through it. What is beyond the map is unknown."""
    rng, far_m = np.random.default_rng(seed), 2.0
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
    grid = voxels.origin, voxels.voxel_m, states.shape
    for start, ray, range_m, unknown_m in zip(starts, rays, ranges, unknown, strict=True):
        met = [
            (first, last, states[index])
            for index, first, last in passages(*grid, start, ray, far_m + 1.0)
        ]
        # a corner is cut if the way through it is shorter than 0.1 mm
        solid = [(a, b) for a, b, state in met if state == OCCUPIED and b - a > 1e-4]
        enters, leaves = min(solid, default=(np.inf, np.inf))
        middle = float(enters + leaves) / 2
        assert range_m == pytest.approx(middle if middle <= far_m else np.inf, abs=1e-9)
        end = min(enters, far_m)
        known = sum(min(b, end) - min(a, end) for a, b, state in met if state != UNKNOWN)
        assert unknown_m == pytest.approx(float(end - known), abs=1e-3)


EDGE_M = 0.5**0.5
CUTS = [
    (0.9e-4, 5.0, np.inf),
    (1.1e-4, 5.0, EDGE_M + 0.55e-4),
    (1.1e-4, EDGE_M + 0.5e-4, np.inf),
]


@pytest.mark.parametrize(("chord_m", "reach", "range_m"), CUTS)
def test_corners_are_cut_up_to_a_tenth_of_a_millimetre(chord_m, reach, range_m):
    """And a return is one if the middle of its way is within reach."""
    states = np.array([[[FREE], [FREE]], [[FREE], [OCCUPIED]]], np.uint8)
    start, ray = [0.5, 1.5 + chord_m / 2**0.5, 0.5], unit(np.array([1.0, -1.0, 0.0]))
    ranges = VoxelEngine(VoxelMap(states, 1.0, np.zeros(3))).cast([start], [[ray]], reach)
    assert_allclose(ranges, [[range_m]], rtol=0, atol=1e-9)


def test_what_is_no_ray_meets_nothing():
    engine = VoxelEngine(VoxelMap(np.full((2, 2, 2), OCCUPIED, np.uint8), 1.0, np.zeros(3)))
    inside, along = np.ones(3), [1.0, 0.0, 0.0]
    assert engine.cast([inside], [[along]], 5.0) == 0.5
    places = [np.nan, 1.0, 1.0], [1.0, 1.0, np.inf]
    for start, ray in [(place, along) for place in places] + [(inside, ray) for ray in BAD_RAYS]:
        assert engine.cross([start], [[ray]], 5.0) == (np.inf, 0.0)
    assert np.isinf(engine.cast([[-9.0, 9.0, 1.0]], [[along]], 50.0)).all()  # past the map
    refuses("two rays of one origin", engine.cast, [inside], [[along]] * 2, 5.0)
