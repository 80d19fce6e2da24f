"""How hard maps are: small maps worked by hand, and laws."""

import itertools
import math

import numpy as np
import pytest
from scipy.sparse.csgraph import shortest_path

from scenegen.truth.difficulty import difficulty, way_difficulty

VOXEL = 0.2


def measured(occupancy):
    return difficulty(occupancy, np.full(occupancy.shape, 2.0, np.float32), VOXEL)


def empty():
    return np.zeros((13, 13, 13), bool)


DIRECTIONS = [step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)]
"""The n-th and the n-th last are opposite."""
LEVEL = [step[2] == 0 for step in DIRECTIONS]


def walked(occupancy, start):
    """Metres from a voxel along each direction, and whether an occupied voxel ends the way."""
    padded = np.pad(np.where(occupancy, 1, 0), 1, constant_values=2)
    steps, ends = [], []
    for direction in DIRECTIONS:
        count = 0
        while not (end := padded[tuple(np.add(start, 1) + np.multiply(count + 1, direction))]):
            count += 1
        steps.append(count)
        ends.append(end == 1)
    return VOXEL * np.multiply(steps, np.linalg.norm(DIRECTIONS, axis=1)), np.array(ends)


@pytest.mark.parametrize("density", [0.0, 0.003, 0.03, 0.3])
def test_ways_are_those_walked_voxel_by_voxel(density):
    occupancy, middle = np.random.default_rng(4).random((13, 17, 14)) < density, (6, 8, 7)
    occupancy[middle] = False
    figures = measured(occupancy)
    metres, blocked = walked(occupancy, middle)
    assert figures.visibility_m == pytest.approx(metres.mean())
    assert figures.passage_m == pytest.approx((metres + metres[::-1]).min())
    units = np.array(DIRECTIONS) / np.linalg.norm(DIRECTIONS, axis=1)[:, None]
    near = np.triu(units @ units.T >= math.sqrt(0.5) - 1e-9, 1)  # 45° apart at most
    differing = (blocked[:, None] != blocked)[near]
    assert figures.dispersion == pytest.approx(differing.mean())
    nodes = [node for node in np.argwhere(~occupancy) if not ((node - middle) % 3).any()]
    level = np.array([walked(occupancy, node)[0][LEVEL] for node in nodes])
    assert figures.traversability == pytest.approx(level.mean() / 0.6)
    assert figures.gap == pytest.approx((level + level[:, ::-1]).min(axis=1).mean() / 0.6)


def test_an_empty_map_is_straight_and_open():
    figures = measured(empty())
    assert (figures.clearance_m, figures.tortuosity) == (2.0, pytest.approx(1.0))


@pytest.mark.parametrize("wall", [8, 9])
def test_a_way_around_a_wall_is_longer(wall):
    """On a lattice of three voxels, a wall of nodes, or between them, from edge to edge but for the
    top layer."""
    occupancy = empty()
    occupancy[wall, :, :12] = True
    found = measured(occupancy)
    nodes = np.argwhere(np.ones((5, 5, 5)))
    steps = np.linalg.norm(nodes[:, None] - nodes, axis=2)
    for a, b in np.argwhere(steps < 1.8):
        way = [n * nodes[b] + (3 - n) * nodes[a] for n in (1, 2, 3)]
        steps[a, b] *= not occupancy[tuple(np.transpose(way))].any()  # 0 is no step
    lengths = shortest_path(np.where(steps < 1.8, steps, 0), indices=62)  # from the middle
    reached = np.isfinite(lengths) & (np.abs(nodes - 2)[:, :2] == 2).any(axis=1)
    low, mid, high = np.sort(np.abs(nodes - 2)).T
    straight = high - mid + math.sqrt(2) * (mid - low) + math.sqrt(3) * low
    assert found.tortuosity == pytest.approx(np.mean(lengths[reached] / straight[reached]))
    assert found.tortuosity > 1.0


def test_a_blocked_middle_has_no_figures():
    occupancy = empty()
    occupancy[6, 6, 6] = True
    clearance, *others = measured(occupancy)
    assert clearance == 0.0
    assert all(map(math.isnan, others))


def test_a_way_is_looked_at_along_its_length():
    way = np.array([(x, 3, 3) for x in range(3, 9)] + [(8, y, 3) for y in range(4, 9)])
    tudf = np.broadcast_to(np.arange(13)[:, None, None] / 10, (13, 13, 13)).astype(np.float32)
    found = way_difficulty(way, 1.0, empty(), tudf, VOXEL)
    assert found.clearance_m == pytest.approx(np.mean([0.3, 0.6, 0.8, 0.8]))
