"""A* finds the shortest path on the lattice: Dijkstra's, from scipy, on a graph built here by other
means."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from lidarsim import GridSpec
from scenegen.model.config import PlanConfig
from scenegen.model.evaluation.planning.astar import Lattice, plan_path

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


def length_of(path):
    return float(np.sqrt((np.diff(path, axis=0) ** 2).sum(axis=1)).sum())


@pytest.mark.parametrize("edge_check", [False, True])
@pytest.mark.parametrize(
    ("step", "density"), [(1, 0.55), (1, 0.75), (2, 0.5), (2, 0.8), (3, 0.3), (3, 0.6)]
)
def test_paths_are_as_short_as_dijkstras(step, density, edge_check):
    """To every free node, reachable or not; and every path is one of free nodes, neighbour to
    neighbour."""
    rng = np.random.default_rng(100 * step + int(10 * density))
    config = PlanConfig(step_voxels=step, edge_check=edge_check)
    grid = GRID if step > 1 else GridSpec(shape=(14, 13, 10))
    lattice = Lattice(grid, step)
    occupied = rng.random(grid.shape) < density
    occupied[tuple(lattice.voxels(lattice.start))] = False
    expected = reference_lengths(occupied, grid, step, edge_check=edge_check)
    nodes = np.indices(lattice.shape).reshape(3, -1).T
    reached = 0
    for node in rng.permutation(nodes)[:400]:
        voxel = tuple(lattice.voxels(node).tolist())
        path, reason = plan_path(occupied, lattice.centres(node), grid, config)
        if path is None:
            assert voxel not in expected
            assert reason == ("goal_blocked" if occupied[voxel] else "no_path")
            continue
        reached += 1
        assert reason is None
        assert length_of(path) == pytest.approx(expected[voxel], abs=1e-9)
        assert_allclose(path[0], (np.array(grid.shape) // 2 + 0.5) * 0.2, atol=1e-12)
        assert_allclose(path[-1], lattice.centres(node), atol=1e-12)
        steps = np.diff(path / (0.2 * step), axis=0)
        assert_allclose(steps, np.rint(steps), atol=1e-9)
        assert (np.abs(np.rint(steps)).max(axis=1) == 1).all()
        assert not occupied[tuple(np.floor(path / 0.2).astype(int).T)].any()
    if not edge_check:
        assert reached > 3


@pytest.mark.parametrize(("step", "weight"), [(1, 4.0), (3, 10.0), (3, 0.0)])
def test_ways_are_weighed_by_their_risk(step, weight):
    """The path found is the cheapest of all, and no dearer than any other."""
    rng, grid = np.random.default_rng(step), GridSpec(shape=(11, 10, 8))
    risk = rng.random(grid.shape).astype(np.float32) ** 2
    occupied = risk > 0.8
    lattice = Lattice(grid, step)
    occupied[tuple(lattice.voxels(lattice.start))] = False
    config = PlanConfig(step_voxels=step, edge_check=True, risk_weight=weight)
    cost = weight * risk
    expected = reference_lengths(occupied, grid, step, edge_check=True, cost=cost)
    reached = 0
    for node in rng.permutation(np.indices(lattice.shape).reshape(3, -1).T)[:200]:
        path, _ = plan_path(occupied, lattice.centres(node), grid, config, risk)
        voxel = tuple(lattice.voxels(node).tolist())
        assert (path is not None) == (voxel in expected)
        if path is None:
            continue
        reached += 1
        voxels = np.floor(path / 0.2).astype(int)
        legs = np.linalg.norm(np.diff(path, axis=0), axis=1)
        pairs = itertools.pairwise(map(tuple, voxels))
        means = np.array([weighed(cost, *pair) for pair in pairs])
        assert legs @ (1 + means) == pytest.approx(expected[voxel], rel=1e-6)
    assert reached > 20


def test_the_default_lattice_is_the_papers():
    """Steps of 0.6 m around voxel (40, 40, 20) of 80 x 80 x 40."""
    lattice = Lattice(GridSpec(), PlanConfig().step_voxels)
    assert lattice.shape == (27, 27, 13)
    assert lattice.voxels(lattice.start).tolist() == [40, 40, 20]
    assert_allclose(
        lattice.centres([1, 0, 0]) - lattice.centres([0, 0, 0]), [0.6, 0, 0], atol=1e-12
    )
    for node in ([0, 0, 0], [26, 26, 12], [3, 20, 7]):
        assert (lattice.voxels(node) >= 0).all()
        assert (lattice.voxels(node) < GridSpec().shape).all()
        assert lattice.node_at(lattice.centres(node)).tolist() == node


def test_a_wall_between_nodes_stops_paths_with_the_edge_check_alone():
    """One voxel thick, between two layers of nodes; with a hole in it, the path goes through the
    hole."""
    grid = GridSpec(shape=(40, 40, 20))
    lattice = Lattice(grid, 3)
    occupied = np.zeros(grid.shape, bool)
    occupied[24] = True  # nodes lie at 20, 23, 26
    goal = lattice.centres(lattice.start + np.array([4, 0, 0]))
    checked, free = PlanConfig(edge_check=True), PlanConfig()
    through, _ = plan_path(occupied, goal, grid, free)
    assert length_of(through) == pytest.approx(2.4)
    assert plan_path(occupied, goal, grid, checked) == (None, "no_path")
    occupied[24, 32, 10] = False  # opposite the node four steps along y
    around, _ = plan_path(occupied, goal, grid, checked)
    assert np.isclose(around[:, 1], 32.5 * 0.2).sum() == 2
    assert length_of(around) == pytest.approx(
        reference_lengths(occupied, grid, 3, edge_check=True)[(32, 20, 10)]
    )


def test_blocked_ends_are_told_apart():
    lattice = Lattice(GRID, 3)
    goal = lattice.centres([0, 0, 0])
    for voxel, reason in (
        ([12, 10, 7], "start_blocked"),
        (lattice.voxels([0, 0, 0]), "goal_blocked"),
    ):
        occupied = np.zeros(GRID.shape, bool)
        occupied[tuple(voxel)] = True
        assert plan_path(occupied, goal, GRID, PlanConfig()) == (None, reason)
    start = plan_path(
        np.zeros(GRID.shape, bool), lattice.centres(lattice.start), GRID, PlanConfig()
    ).waypoints
    assert_allclose(start, [[2.5, 2.1, 1.5]])


@pytest.mark.parametrize(
    "goal", [[2.5, 2.1, 1.6], [2.7, 2.1, 1.5], [-0.5, 2.1, 1.5], [99, 2, 2], [2.5, 2.1, np.nan]]
)
def test_a_goal_that_is_no_node_is_refused(goal):
    with pytest.raises(ValueError, match="goal"):
        plan_path(np.zeros(GRID.shape, bool), goal, GRID, PlanConfig())


def test_a_map_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"occupied: shape \(24, 21, 13\)"):
        plan_path(np.zeros((24, 21, 13), bool), [2.5, 2.1, 1.5], GRID, PlanConfig())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("step_voxels", 0),
        ("iterations", -1),
        ("safety_m", -0.1),
        ("clearance_weight", np.inf),
        ("goal_faces", "top"),
        ("field", "exact"),
    ],
)
def test_parameters_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        PlanConfig(**{name: value})  # type: ignore[arg-type]
