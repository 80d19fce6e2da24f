"""A* finds the shortest path on the lattice: Dijkstra's, from scipy, on a graph built here by other
means."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from lidarsim import GridSpec
from scenegen.model.bench.planner import Lattice, plan_path
from scenegen.model.config import PlanConfig
from tests.refusals import refuses

GRID = GridSpec(shape=(24, 21, 14))


def reference_lengths(
    occupied,
    grid,
    step,
    *,
    edge_check,
    cost=None,
):
    """Shortest lengths in metres from the middle to every node that can be reached, by voxel; a
    metre is longer by the mean `cost` of the voxels on the way.

    Nodes are found by walking outwards from the middle; with the edge check, 40 points of every
    edge are looked up.
    """
    middle = tuple(n // 2 for n in grid.shape)
    lines = [
        [v for v in range(n) if (v - m) % step == 0]
        for n, m in zip(grid.shape, middle, strict=True)
    ]
    number = {v: n for n, v in enumerate(itertools.product(*lines)) if not occupied[v]}
    if middle not in number:
        return {}
    along = ((np.arange(40) + 0.37) / 40)[:, None]  # never right at a voxel's edge
    rows, columns, weights = [], [], []
    for voxel, direction in itertools.product(number, itertools.product((-1, 0, 1), repeat=3)):
        there = tuple(v + step * d for v, d in zip(voxel, direction, strict=True))
        if there == voxel or there not in number:
            continue
        crossed = np.floor(np.array(voxel) + 0.5 + along * step * np.array(direction)).astype(int)
        if not (edge_check and occupied[tuple(crossed.T)].any()):
            rows.append(number[voxel])
            columns.append(number[there])
            length = step * grid.voxel_m * float(np.linalg.norm(direction))
            weights.append(length * (1 + weighed(cost, voxel, there)))
    count = max(number.values()) + 1
    lengths = dijkstra(
        csr_array((weights, (rows, columns)), shape=(count, count)), indices=number[middle]
    )
    return {voxel: lengths[n] for voxel, n in number.items() if np.isfinite(lengths[n])}


def weighed(cost, voxel, there):
    """The mean cost of the voxels stepped on from one node to the next, the first left out."""
    if cost is None:
        return 0.0
    steps = max(abs(b - a) for a, b in zip(voxel, there, strict=True))
    line = np.linspace(voxel, there, steps + 1)[1:]
    return float(cost[tuple(np.rint(line).astype(int).T)].mean())


def price_of(path, cost):
    """Its length in metres, and longer by what the reference takes for the risk on the way."""
    legs = np.linalg.norm(np.diff(path, axis=0), axis=1)
    voxels = itertools.pairwise(map(tuple, np.floor(path / 0.2).astype(int)))
    return float(legs @ np.array([1 + weighed(cost, *pair) for pair in voxels]))


@pytest.mark.parametrize("edge_check", [False, True])
@pytest.mark.parametrize(
    ("step", "density", "weight"),
    [(1, 0.55, 0.0), (1, 0.75, 0.0), (2, 0.5, 0.0), (3, 0.6, 0.0), (2, 0.3, 4.0), (3, 0.3, 10.0)],
)
def test_paths_are_as_short_as_dijkstras(step, density, weight, edge_check):
    """To every free node, reachable or not, weighed by the risk or not; and every path is one of
    free nodes, neighbour to neighbour."""
    rng = np.random.default_rng(100 * step + int(10 * density))
    config = PlanConfig(step_voxels=step, edge_check=edge_check, risk_weight=weight)
    grid = GRID if step > 1 else GridSpec(shape=(14, 13, 10))
    lattice = Lattice(grid, step)
    occupied = rng.random(grid.shape) < density
    occupied[tuple(lattice.voxels(lattice.start))] = False
    risk = rng.random(grid.shape).astype(np.float32) ** 2 if weight else None
    cost = None if risk is None else weight * risk
    expected = reference_lengths(occupied, grid, step, edge_check=edge_check, cost=cost)
    nodes = np.indices(lattice.shape).reshape(3, -1).T
    reached = 0
    for node in rng.permutation(nodes)[:150]:
        voxel = tuple(lattice.voxels(node).tolist())
        path, reason = plan_path(occupied, lattice.centres(node), grid, config, risk)
        if path is None:
            assert voxel not in expected
            assert reason == ("goal_blocked" if occupied[voxel] else "no_path")
            continue
        reached += 1
        assert reason is None
        assert price_of(path, cost) == pytest.approx(expected[voxel], rel=1e-6, abs=1e-9)
        assert_allclose(path[0], (np.array(grid.shape) // 2 + 0.5) * 0.2, atol=1e-12)
        assert_allclose(path[-1], lattice.centres(node), atol=1e-12)
        steps = np.diff(path / (0.2 * step), axis=0)
        assert_allclose(steps, np.rint(steps), atol=1e-9)
        assert (np.abs(np.rint(steps)).max(axis=1) == 1).all()
        assert not occupied[tuple(np.floor(path / 0.2).astype(int).T)].any()
    if not edge_check or weight:
        assert reached > 3


def test_a_goal_that_is_no_node_and_a_map_of_another_shape_are_refused():
    free, start = np.zeros(GRID.shape, bool), [2.5, 2.1, 1.5]
    for goal in ([2.5, 2.1, 1.6], [2.7, 2.1, 1.5], [99, 2, 2], [2.5, 2.1, np.nan]):
        refuses(goal, plan_path, free, goal, GRID, PlanConfig())
    refuses("shape", plan_path, free[1:], start, GRID, PlanConfig())
