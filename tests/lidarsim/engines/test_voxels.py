"""Rays through maps of voxels, against points sampled along them."""

import itertools

import numpy as np
import pytest

from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelEngine, VoxelMap
from tests.lidarsim.engines.test_laws import BAD_RAYS
from tests.lidarsim.reference import unit
from tests.refusals import refuses

STEP_M = 5e-4


def a_map(seed):
    rng = np.random.default_rng(seed)
    states = rng.choice([UNKNOWN, FREE, OCCUPIED], (12, 9, 7), p=[0.2, 0.75, 0.05])
    return VoxelMap(states.astype(np.uint8), 0.25, rng.uniform(-3, 3, 3))


def states_along(voxels, start, ray, far_m):
    """The state at the middle of every step."""
    points = start + ((np.arange(int(far_m / STEP_M)) + 0.5) * STEP_M)[:, None] * ray
    index = np.floor((points - voxels.origin) / voxels.voxel_m).astype(int)
    inside = ((index >= 0) & (index < voxels.states.shape)).all(axis=1)
    found = np.full(len(points), UNKNOWN, np.uint8)
    found[inside] = voxels.states[tuple(index[inside].T)]
    return found


@pytest.mark.parametrize("seed", range(3))
def test_rays_meet_what_points_along_them_do(seed):
    voxels, rng, far_m = a_map(seed), np.random.default_rng(seed), 4.0
    low, high = voxels.bounds
    starts = rng.uniform(low - 1, high + 1, (40, 3))
    rays = rng.normal(size=(40, 3))
    rays[:6] = np.repeat(np.eye(3), 2, axis=0) * np.tile([1, -1], 3)[:, None]
    rays = unit(rays)
    asked = starts, rays[:, None], far_m
    ranges, unknown = VoxelEngine(voxels).cross(*asked)
    for limits in itertools.product((0.0, 0.6, 2.0), (0.2, 0.5, 0.9)):  # what says yes walks all
        engine = VoxelEngine(voxels)
        assert engine.mostly_known(*asked, *limits) == ((unknown > limits[0]).mean() <= limits[1])
        assert np.array_equal(engine.cross(*asked), (ranges, unknown))
    missed = 0
    for start, ray, range_m, unknown_m in zip(
        starts, rays, ranges[:, 0], unknown[:, 0], strict=True
    ):
        states = states_along(voxels, start, ray, far_m)
        met = np.flatnonzero(states == OCCUPIED)
        if np.isfinite(range_m):
            inside = states_along(voxels, start + (range_m - STEP_M / 2) * ray, ray, 2 * STEP_M)
            assert inside[0] == OCCUPIED  # a return lies in an occupied voxel
            begin = met[0] * STEP_M  # or a corner is cut that sampling, or the least chord, leaves
            assert range_m - begin <= np.sqrt(3) * voxels.voxel_m / 2 + 2 * STEP_M
            crossed = np.count_nonzero(states[: int(range_m / STEP_M)] == UNKNOWN)
        else:
            missed += 1
            # the middle of the way through the first one may lie beyond the range
            assert not len(met) or met[0] * STEP_M > far_m - voxels.voxel_m
            continue
        assert unknown_m == pytest.approx(crossed * STEP_M, abs=20 * STEP_M)
    assert 0 < missed < len(starts)


def test_a_ray_returns_from_the_middle_of_its_way():
    states = np.full((4, 1, 1), FREE, np.uint8)
    states[1], states[2] = UNKNOWN, OCCUPIED
    engine = VoxelEngine(VoxelMap(states, 0.5, np.zeros(3)))
    cases = {
        (0.1, 1.0, 10.0): (1.15, 0.5),
        (0.1, 1.0, 1.1): (np.inf, 0.5),  # the range ends before the middle
        (1.2, 1.0, 10.0): (0.15, 0.0),  # from within
        (0.1, -1.0, 3.0): (np.inf, 2.9),  # what lies beyond the map is unknown
    }
    for (x, along, far_m), expected in cases.items():
        found = engine.cross([[x, 0.25, 0.25]], [[[along, 0.0, 0.0]]], far_m)
        assert [float(one[0, 0]) for one in found] == pytest.approx(expected), x


def test_what_is_no_ray_meets_nothing():
    engine = VoxelEngine(VoxelMap(np.full((2, 2, 2), OCCUPIED, np.uint8), 1.0, np.zeros(3)))
    inside, along = [1.0, 1.0, 1.0], [1.0, 0.0, 0.0]
    assert np.isfinite(engine.cast([inside], [[along]], 5.0)).all()
    for start, ray in (
        ([np.nan, 1.0, 1.0], along),
        ([1.0, 1.0, np.inf], along),
        *((inside, ray) for ray in BAD_RAYS),
    ):
        assert engine.cross([start], [[ray]], 5.0) == (np.inf, 0.0)
    assert np.isinf(engine.cast([[-9.0, 9.0, 1.0]], [[along]], 50.0)).all()  # past the map
    refuses("two rays of one origin", engine.cast, [inside], [[along]] * 2, 5.0)
