"""A* finds the shortest path on the lattice: Dijkstra's, from scipy, on a graph built here by other
means."""

import itertools
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from lidarsim import GridSpec
from scenegen.model.bench.planner import Lattice, plan_path
from scenegen.model.config import PlanConfig
from tests.scenegen import each_case

GRID = GridSpec(shape=(24, 21, 14))


def reference_lengths(occupied, grid, step, edge_check, cost):
    """Shortest lengths in metres from the middle to every free node, by voxel; a metre is longer by
    the mean `cost` of the voxels on the way. With the edge check, 40 points of every edge are
    looked up."""
    free, middle = np.argwhere(~occupied), np.array(grid.shape) // 2
    nodes = free[((free - middle) % step == 0).all(axis=1)].tolist()
    number = {tuple(voxel): n for n, voxel in enumerate(nodes)}
    along = ((np.arange(40) + 0.37) / 40)[:, None]  # never right at a voxel's edge
    weights = {}
    for voxel, way in itertools.product(number, itertools.product((-step, 0, step), repeat=3)):
        there = tuple(np.add(voxel, way).tolist())
        if there == voxel or there not in number:
            continue
        crossed = np.floor(np.array(voxel) + 0.5 + along * way).astype(int)
        if not (edge_check and occupied[tuple(crossed.T)].any()):
            length = grid.voxel_m * np.linalg.norm(way)
            weights[number[voxel], number[there]] = length * (1 + weighed(cost, voxel, there))
    edges = [*weights.values()], tuple(np.transpose([*weights]))
    graph = csr_array(edges, shape=(len(number), len(number)))
    return dict(zip(number, dijkstra(graph, indices=number[tuple(middle)]), strict=True))


def weighed(cost, voxel, there):
    """The mean cost of the voxels stepped on from one node to the next, the first left out."""
    steps = np.abs(np.subtract(there, voxel)).max()
    line = np.linspace(voxel, there, steps + 1)[1:]
    return float(cost[tuple(np.rint(line).astype(int).T)].mean())


def price_of(path, cost):
    """Its length in metres, and longer by what the reference takes for the risk on the way."""
    legs = np.linalg.norm(np.diff(path, axis=0), axis=1)
    voxels = itertools.pairwise(map(tuple, np.floor(path / 0.2).astype(int)))
    return float(legs @ np.array([1 + weighed(cost, *pair) for pair in voxels]))


@pytest.mark.parametrize("edge_check", [False, True])
@each_case("../model/astar", "step density weight", json.loads)
def test_paths_are_as_short_as_dijkstras(step, density, weight, edge_check):
    """To every free node, reachable or not, weighed by the risk or not; and every path is one of
    free nodes, neighbour to neighbour."""
    rng = np.random.default_rng(100 * step + int(10 * density))
    config = PlanConfig(step_voxels=step, edge_check=edge_check, risk_weight=weight)
    grid = GRID if step > 1 else GridSpec(shape=(14, 13, 10))
    lattice = Lattice(grid, step)
    occupied = rng.random(grid.shape) < density
    occupied[tuple(lattice.voxels(lattice.start))] = False
    risk = rng.random(grid.shape).astype(np.float32) ** 2
    cost = weight * risk
    lengths = reference_lengths(occupied, grid, step, edge_check, cost)
    reached = 0
    for node in rng.permutation(np.indices(lattice.shape).reshape(3, -1).T)[:150]:
        voxel, goal = tuple(lattice.voxels(node).tolist()), lattice.centres(node)
        path, reason = plan_path(occupied, goal, grid, config, risk if weight else None)
        if path is None:
            assert reason == ("goal_blocked" if occupied[voxel] else "no_path")
            assert lengths.get(voxel, np.inf) == np.inf
            continue
        reached += 1
        assert price_of(path, cost) == pytest.approx(lengths[voxel], rel=1e-6, abs=1e-9)
        assert_allclose(path[[0, -1]], [lattice.centres(lattice.start), goal], atol=1e-12)
        steps = np.diff(path / (0.2 * step), axis=0)
        assert_allclose(steps, np.sign(np.rint(steps)), atol=1e-9)
        assert not occupied[tuple(np.floor(path / 0.2).astype(int).T)].any()
    if not edge_check or weight:
        assert reached > 3
