"""Laws of the voxel grids: observed by the floor formula, free by overlap of segments with boxes.

The truth comes from `reference`: a slab test of every voxel against every ray, in rational
arithmetic, with voxels shrunk (which must be free) and grown (which may be) by 1e-9 m.
"""

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import BeamTable, GridSpec, Pose, Scan, voxelize
from lidarsim.pose import rotate
from tests.lidarsim import reference
from tests.refusals import refuses
from tests.scenegen import cases

SMALL = GridSpec(shape=(6, 5, 4), voxel_m=0.3)
DYADIC = GridSpec(shape=(8, 8, 8), voxel_m=0.25)
"""A grid whose planes are exact in float64 about the origin: no rounding can excuse a wrong
side."""


def scan_of(rays, ranges, position=(0.0, 0.0, 0.0), max_range_m=10.0):
    """A scan with given world directions (n, 3), made unit, and ranges (n,)."""
    rays = np.array(rays, float)
    rays = reference.unit(rays / np.abs(rays).max(axis=-1, keepdims=True))
    table = np.pad(rays, ((0, 0), (0, 1)))[:, None]  # all at once
    lidar = BeamTable(rays=table, max_range_m=max_range_m)
    return Scan(np.float32(ranges)[:, None], Pose.level(position), lidar)


def assert_right(scan, grid, got, margin_m=reference.TOUCH_M):
    """The grids of a scan against the references; how many voxels are free for certain, and how
    many by the margin."""
    assert got.observed.shape == got.free.shape == grid.shape
    assert got.observed.dtype == got.free.dtype == np.bool_
    given = got.origin, grid.voxel_m, grid.shape, scan.pose.position, scan.directions
    observed = reference.observed(*given, scan.ranges)
    assert_array_equal(got.observed, observed)
    reach = np.where(np.isinf(scan.ranges), scan.lidar.max_range_m, np.float64(scan.ranges))
    must = (reference.overlaps(*given, reach, -margin_m) >= reference.TOUCH_M) & ~observed
    assert not np.argwhere(must & ~got.free).tolist(), "not free but crossed"
    beyond = got.free & ~must
    if beyond.any():  # seldom, and it takes as long again
        may = (reference.overlaps(*given, reach, margin_m) > 0) & ~observed
        assert not np.argwhere(beyond & ~may).tolist(), "free but not crossed"
    return must.sum(), beyond.sum()


PARTS, REACHES, PLACES, GRIDS = map(json.loads, sum(cases("../lidarsim/voxelization"), ()))
GRIDS = [GridSpec(shape=shape, voxel_m=voxel_m) for shape, voxel_m in GRIDS]


def test_any_rays_on_small_grids_match_rational_arithmetic():
    """Parallel, all but parallel, diagonal, tiny, endless and usual rays, around the sensor or with
    an `origin` from which they enter the map from outside, or miss it."""
    sure = unsure = 0
    for seed in range(160):
        rng = np.random.default_rng(seed)
        position, grid = PLACES[seed % 4], GRIDS[seed // 4 % len(GRIDS)]
        extent = grid.extent_m
        origin = position - extent / 2 + rng.uniform(-1, 1, 3) * extent if seed % 2 else None
        shape, special = (int(rng.integers(1, 9)), 3), 0.6 if seed % 3 else 0.0
        rays, reach = rng.uniform(-1, 1, shape), rng.exponential(extent.max(), shape[0])
        for usual, values in ((rays, PARTS), (reach, REACHES)):
            chosen = rng.random(usual.shape) < special
            usual[chosen] = rng.choice(values, chosen.sum())
        rays[abs(rays).max(axis=1) < 1e-3, 0] = 1.0
        if origin is not None:  # every other ray goes through the map
            rays[::2] = origin + rng.uniform(0, 1, rays[::2].shape) * extent - position
        scan = scan_of(rays, reach, position, max_range_m=float(rng.uniform(0.1, 20)))
        got = voxelize(scan, grid, origin)
        assert_array_equal(got.origin, grid.origin_at(position) if origin is None else origin)
        counts = assert_right(scan, grid, got)
        if origin is not None and not special:
            sure, unsure = np.add((sure, unsure), counts)
    assert unsure < 0.01 * sure  # the margin excuses next to nothing


def test_rays_within_a_plane_free_the_voxels_above():
    """On a grid exact in float64 the sensor's planes are no matter of rounding: voxels are
    half-open, and so is the map, of which the sensor may lie on a border. Free is what rational
    arithmetic finds, with no margin: none of these rays comes within 1e-9 m of an edge."""
    crossed = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        rays = rng.normal(size=(6, 3))
        rays[np.arange(6), rng.integers(0, 3, 6)] = rng.choice([0.0, -0.0], 6)
        rays[:2] *= np.eye(3)[rng.integers(0, 3, 2)]  # along an axis, within two planes
        rays[:2, 0] += (rays[:2] == 0).all(axis=1)
        reach = np.where(rng.random(6) < 0.5, np.inf, rng.uniform(0.1, 1.5, 6))
        reach[rng.random(6) < 0.1] = rng.choice([0.0, 1e-7, 1e-3])
        scan, origin = scan_of(rays, reach), rng.choice([-2.0, -1.0, 0.0], 3, p=[0.15, 0.7, 0.15])
        sure, unsure = assert_right(scan, DYADIC, voxelize(scan, DYADIC, origin), margin_m=0.0)
        assert unsure == 0
        crossed += sure
    assert crossed > 400


@pytest.mark.parametrize(
    ("reach", "most", "freed"),
    [(np.inf, 0.5 + 5e-10, False), (np.inf, 0.5 + 2e-9, True), (0.5 - 2**-25, 10.0, False)],
)
def test_what_lies_behind_a_rays_end_is_not_freed(reach, most, freed):
    """Half a metre ahead a voxel begins, or the map does: free is what a ray without a return meets
    for more than 1e-9 m, and nothing behind a return 3e-8 m before that plane, where a wall is."""
    scan = scan_of([[1.0, 0.0, 0.0]], [reach], max_range_m=most)
    for low in (-1.0, 0.5):
        got = voxelize(scan, DYADIC, np.array([low, -1.0, -1.0]))
        assert got.free[int((0.5 - low) / 0.25), 4, 4] == freed


@pytest.mark.parametrize(("chord_m", "freed"), [(5e-10, False), (2e-9, True)])
def test_a_corner_is_crossed_by_more_than_a_nanometre(chord_m, freed):
    place = (-0.1, 0.1 + chord_m / 2**0.5, 0.1)
    scan = scan_of([[1.0, -1.0, 0.0]], [np.inf], place, max_range_m=0.5)
    assert voxelize(scan, DYADIC, -np.ones(3)).free[4, 4, 4] == freed


def test_ranges_and_places_that_are_none_are_refused():
    """The kernels would read beyond them, or walk without end."""
    scan = scan_of(np.eye(3), np.ones(3))
    for wrong in (np.ones((2, 1)), np.ones((3, 2)), np.float32([[np.nan], [-1], [0]])):
        refuses(wrong.shape, Scan, wrong, scan.pose, scan.lidar)
    for origin in ((0, 0), (0, 0, np.nan)):
        refuses(origin, voxelize, scan, SMALL, origin)
    refuses("rotate", rotate, scan.pose.quaternion, np.ones((3, 4)))
