"""How hard maps are: small maps worked by hand, and laws."""

import itertools
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarsim import GridSpec
from scenegen.truth import distance_field
from scenegen.truth.difficulty import difficulty, way_difficulty
from scenegen.truth.guides import hardness
from tests.conftest import small_recipe

VOXEL = 0.2


def measured(occupancy):
    return difficulty(occupancy, np.full(occupancy.shape, 2.0, np.float32), VOXEL)


def empty():
    return np.zeros((13, 13, 13), np.bool_)


def test_an_empty_map():
    found = measured(empty())
    assert found.clearance_m == 2.0
    # six voxels to every edge: along 6 axes, 12 diagonals of faces, 8 of the cube
    mean = 6 * VOXEL * (6 + 12 * math.sqrt(2) + 8 * math.sqrt(3)) / 26
    assert found.visibility_m == pytest.approx(mean)
    assert found.dispersion == 0.0
    assert found.passage_m == pytest.approx(12 * VOXEL)
    assert found.tortuosity == pytest.approx(1.0)
    # the shortest way through a node: along x, or across the nearest corner of the plan
    across = [
        min(12.0, math.sqrt(2) * min(12 - abs(x - y), 12 - abs(x + y - 12)))
        for x in range(0, 13, 3)
        for y in range(0, 13, 3)
    ]
    assert found.gap == pytest.approx(np.mean(across) * VOXEL / 0.6)
    assert found.obstruction == pytest.approx(4.0 / 2 / (2.0 - 0.15))
    assert (found.occlusion, found.turning) == (0.0, 0.0)


def test_an_obstacle_ahead_occludes_by_its_distance():
    occupancy = np.zeros((41, 21, 21), np.bool_)
    occupancy[30, 10, 10] = True  # 6 m from the start, right ahead
    occupancy[5, 0, 10] = True  # aside, never within 36 degrees of the direction
    path = np.array([(0, 10, 10), (10, 10, 10), (20, 10, 10)])
    far = np.full(occupancy.shape, 2.0, np.float32)
    found = hardness([path], occupancy, far, VOXEL)
    ways = [6.0 - 0.4 * look for look in range(1, 10)]
    assert found.occlusion == pytest.approx(np.mean([0.55 * 4 / way * (way <= 4) for way in ways]))
    narrow = np.full(occupancy.shape, 0.55, np.float32)
    assert hardness([path], occupancy, narrow, VOXEL).obstruction == pytest.approx(4 / 2 / 0.4)


def test_corners_count_by_their_angles_and_only_where_they_are_needed():
    occupancy = np.zeros((21, 21, 5), np.bool_)
    far = np.full(occupancy.shape, 2.0, np.float32)
    path = np.array([(0, 0, 2), (5, 0, 2), (10, 0, 2), (10, 5, 2), (10, 10, 2)])
    assert hardness([path], occupancy, far, VOXEL).turning == 0.0  # its ends see each other
    occupancy[1:10, 1:10, 2] = True
    found = hardness([path], occupancy, far, VOXEL)
    assert found.turning == pytest.approx((math.e - 1) / 4.0)
    assert all(map(math.isnan, hardness([], occupancy, far, VOXEL)))


def test_a_wall_with_a_slit():
    """A wall two voxels beyond the middle, in which one voxel of the line of sight is free."""
    occupancy = empty()
    occupancy[8] = True
    occupancy[8, 6, 6] = False
    found = measured(occupancy)
    # of the nine directions with x > 0, eight end one voxel before the wall
    blocked = VOXEL * 1 * (4 * math.sqrt(2) + 4 * math.sqrt(3))
    others = VOXEL * 6 * (6 + 8 * math.sqrt(2) + 4 * math.sqrt(3))
    assert found.visibility_m == pytest.approx((blocked + others) / 26)
    # the open one has four neighbours at 45 degrees; the four edges of the ring, with x = 0, four
    # each to the blocked ones at 45 degrees or less
    pairs = [
        (a, b)
        for n, a in enumerate(DIRECTIONS)
        for b in DIRECTIONS[n + 1 :]
        if np.dot(a, b) >= (math.sqrt(0.5) - 1e-9) * np.linalg.norm(a) * np.linalg.norm(b)
    ]
    shut = [d[0] > 0 and d != (1, 0, 0) for d in DIRECTIONS]
    differing = [shut[DIRECTIONS.index(a)] != shut[DIRECTIONS.index(b)] for a, b in pairs]
    assert found.dispersion == pytest.approx(np.mean(differing))
    assert found.passage_m == pytest.approx(VOXEL * (1 + 6) * math.sqrt(2))


DIRECTIONS = [
    (x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)
]


@pytest.mark.parametrize("wall", [8, 9])
def test_a_way_around_a_wall_is_longer(wall):
    """On a lattice of three voxels, a wall of nodes, or between them, from edge to edge but for the
    top layer."""
    occupancy = empty()
    occupancy[wall, :, :12] = True
    found = measured(occupancy)
    start, lengths = (2, 2, 2), {(2, 2, 2): 0.0}
    ways = [
        (a, b)
        for a, b in itertools.product(np.ndindex(5, 5, 5), repeat=2)
        if math.dist(a, b) < 1.8
        and not any(occupancy[tuple(n * np.array(b) + (3 - n) * np.array(a))] for n in (1, 2, 3))
    ]
    for _ in range(20):  # Bellman and Ford
        for a, b in ways:
            if a in lengths:
                lengths[b] = min(lengths.get(b, math.inf), lengths[a] + math.dist(a, b))
    ratios = []
    for node, length in lengths.items():
        if node[0] in (0, 4) or node[1] in (0, 4):
            low, mid, high = sorted(abs(p - q) for p, q in zip(node, start, strict=True))
            ratios.append(length / (high - mid + math.sqrt(2) * (mid - low) + math.sqrt(3) * low))
    assert found.tortuosity == pytest.approx(np.mean(ratios))
    assert found.tortuosity > 1.0


def test_traversability_is_the_mean_way_in_diameters():
    occupancy = np.ones((7, 7, 1), np.bool_)
    occupancy[:, 3] = False  # a corridor along x, whose nodes are 0, 3 and 6
    # from 0 and 6, 6 voxels one way; from 3, 3 both ways; sideways and diagonally none
    assert measured(occupancy).traversability == pytest.approx((6 + 6 + 6) * VOXEL / 0.6 / 24)


def test_a_blocked_middle_has_no_figures():
    occupancy = empty()
    occupancy[6, 6, 6] = True
    found = measured(occupancy)
    assert found.clearance_m == 0.0
    assert all(map(math.isnan, found[1:]))


def test_figures_do_not_change_where_a_map_is_turned():
    rng, grid = np.random.default_rng(2), small_recipe().grid
    occupancy = rng.random((25, 25, 17)) < 0.05
    occupancy[12, 12, 8] = False
    found = difficulty(occupancy, distance_field(occupancy, grid), grid.voxel_m)
    turned = np.ascontiguousarray(np.rot90(occupancy))
    again = difficulty(turned, distance_field(turned, grid), grid.voxel_m)
    # of two ways as long as each other, one is taken: what lies along it may differ
    assert_allclose(found[:7], again[:7], rtol=1e-12)


def test_a_way_that_begins_in_the_middle_sees_what_the_map_tells_of_it():
    """Of two voxels, the first is looked from."""
    occupancy = empty()
    occupancy[8, :, :] = True
    occupancy[8, 6, 6] = occupancy[2, 2, 2] = False
    tudf = distance_field(occupancy, GridSpec(shape=(13, 13, 13)))
    found = way_difficulty(np.array([(6, 6, 6), (7, 6, 6)]), occupancy, tudf, VOXEL)
    whole = difficulty(occupancy, tudf, VOXEL)
    for name in ("clearance_m", "visibility_m", "dispersion", "passage_m", "traversability", "gap"):
        assert getattr(found, name) == getattr(whole, name), name


def test_a_way_round_a_corner_is_longer_than_straight():
    way = np.array([(x, 3, 3) for x in range(3, 9)] + [(8, y, 3) for y in range(4, 9)])
    tudf = np.broadcast_to(np.arange(13)[:, None, None] / 10, (13, 13, 13)).astype(np.float32)
    found = way_difficulty(way, empty(), tudf, VOXEL)
    assert found.tortuosity == pytest.approx(10 / math.sqrt(50))
    assert found.clearance_m == pytest.approx(np.mean([0.3, 0.6, 0.8, 0.8]))
