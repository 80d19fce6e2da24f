"""Trials are judged in the truth as a slow reference judges them, on random maps; their goals are
free and reachable; and the careful planner keeps to its map."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import ndimage
from scipy.interpolate import RegularGridInterpolator

from lidarsim import GridSpec
from scenegen.model.bench.planner import Lattice, Plan, plan_path, refine
from scenegen.model.bench.trials import draw_trials, judge, met, plan_trial, run_trial
from scenegen.model.config import PlanConfig
from scenegen.truth import distance_field
from tests.refusals import refuses

GRID = GridSpec(shape=(40, 40, 20))
LATTICE = Lattice(
    GRID, 3
)  # nodes at voxels 2, 5 ... 38 in x and y, at 1, 4 ... 19 in z; the start is (20, 20, 10)
EAST = LATTICE.centres([12, 6, 3])  # voxel (38, 20, 10): straight along x
WAY = LATTICE.centres([[6, 6, 3], [9, 6, 3]])
PLAN = PlanConfig()
FREE = np.zeros(GRID.shape, bool)
FAR = np.full(GRID.shape, 2.0, np.float32)


def scattered(seed):
    """Random pillars, free around the start."""
    seeds = np.random.default_rng(seed).random(GRID.shape) < 0.002
    occupied = ndimage.binary_dilation(seeds, np.ones((2, 2, 11)))
    occupied[18:23, 18:23] = False
    return occupied


def trials_in(truth, count, seed, **more):
    """Trials of a stream of its own."""
    rng = np.random.default_rng(seed)
    return draw_trials(truth, GRID, PLAN, count=count, rng=rng, **more)


def legs_of(path):
    """Of each leg, points at most 0.05 m apart."""
    pairs = list(itertools.pairwise(path))
    pieces = [int(np.ceil(np.linalg.norm(b - a) / 0.05 - 1e-9)) for a, b in pairs]
    return [np.linspace(*pair, count + 1) for pair, count in zip(pairs, pieces, strict=True)]


def is_clear(path, truth):
    voxels = np.floor(np.concatenate(legs_of(path)) / 0.2).astype(int)
    return not truth[tuple(voxels.T)].any()


def reference_of(path, tudf):
    """Length, mean and least clearance, read by scipy and averaged along the path."""
    axes = [(np.arange(n) + 0.5) * 0.2 for n in GRID.shape]
    read = RegularGridInterpolator(axes, tudf.astype(float), bounds_error=False, fill_value=None)
    legs = legs_of(path)
    lengths = np.concatenate([np.linalg.norm(np.diff(leg, axis=0), axis=1) for leg in legs])
    clearances = [read(leg) for leg in legs]
    middles = np.concatenate([(leg[1:] + leg[:-1]) / 2 for leg in clearances])
    return lengths.sum(), np.average(middles, weights=lengths), np.concatenate(clearances).min()


def test_measurements_are_those_of_a_reference():
    outcomes = set()
    for seed in range(12):
        truth, pred = scattered(seed), scattered(100 + seed)
        if seed % 2:
            pred &= truth  # else obstacles that are not there push paths away, too
        else:
            truth = np.random.default_rng(seed).random(GRID.shape) < 0.01
        if seed == 0:
            pred[29] = True  # a wall of nodes, so that some goals cannot be reached
        tudf, tudf_pred = distance_field(truth, GRID), distance_field(pred, GRID)
        for goal in trials_in(truth, 5, seed).goals:
            result = run_trial(pred, tudf_pred, truth, tudf, goal, GRID, PLAN)
            initial, reason = plan_path(pred, goal, GRID, PLAN)
            if initial is None:
                assert (result.success, result.cause) == (False, reason)
                assert np.isnan(result.length_m)
                outcomes.add(reason)
                continue
            path = refine(initial, tudf_pred, GRID, PLAN)
            actual = result.length_m, result.mean_clearance_m, result.min_clearance_m
            assert actual == pytest.approx(reference_of(path, tudf))
            before, after = is_clear(initial, truth), is_clear(path, truth)
            cause = "refined_into_obstacle" if before else "initial_collides"
            assert (result.success, result.cause) == (after, None if after else cause)
            outcomes.add((before, after))
    assert len(outcomes - {"goal_blocked"}) == 5  # refinement saves some paths, and spoils others


def test_other_shapes_and_places_are_refused():
    maps = {"occupied": FREE, "tudf": FAR, "occupancy_truth": FREE, "tudf_truth": FAR}
    for name, values in maps.items():
        wrong = (maps | {name: values[1:]}).values()
        assert name in refuses(name, run_trial, *wrong, EAST, GRID, PLAN)
    for end in (4.1, -0.1):  # beyond the map
        path = np.array([[2.0] * 3, [end] * 3])
        refuses(end, judge, Plan(path, None), path, FREE, FAR, GRID)
    for offset in ([0, 0, 0.1], [-0.2, 0, 0], [90, 0, 0], [0, 0, np.nan]):  # to no node
        refuses(offset, plan_path, FREE, EAST + offset, GRID, PLAN)
    refuses("refine", refine, WAY, FAR[1:], GRID, PLAN)


def test_hits_are_the_paths_occupied_voxels():
    """In its order; the last voxel of the path is number 30."""
    truth = FREE.copy()
    truth[[25, 26, 30, 35], 20, 10] = True  # of which one is beyond it
    path = np.add(WAY, [[0, 0, 0], [0.2, 0, 0]])
    numbers = np.arange(truth.size).reshape(GRID.shape)[[25, 26, 30], 20, 10].tolist()
    measured, clear = (judge(Plan(path, None), path, one, FAR, GRID) for one in (truth, FREE))
    assert (measured.hits, measured.hit) == (tuple(numbers), numbers[0])
    assert clear.hit is None


def test_goals_are_reachable(rng):
    """Different ones, which follow from the stream alone; more of them begin alike."""
    truth = rng.random(GRID.shape) < 0.3
    truth[20, 20, 10] = False
    goals = trials_in(truth, 80, 0).goals
    assert len(np.unique(goals, axis=0)) == 80
    assert {plan_path(truth, goal, GRID, PLAN).reason for goal in goals} == {None}
    assert_array_equal(trials_in(truth, 20, 0).goals, goals[:20])
    assert not np.array_equal(trials_in(truth, 80, 1).goals, goals)


def test_all_goals_are_tried_and_excluded_ones_counted():
    """Nodes of the outermost layer. A wall cuts off the layer x = 38, all of 13 x 7 goals; one of
    the others lies in an obstacle."""
    truth = FREE.copy()
    truth[35] = truth[2, 2, 1] = True
    trials = trials_in(truth, 10_000, 0)
    layer, rim = 13 * 7, 13 * 13 * 7 - 11 * 11 * 5
    blocked = layer - 11 * 5 + 1
    assert len(trials.goals) == rim - layer - blocked
    assert trials.excluded == {"no_path": layer, "goal_blocked": blocked}
    assert (trials.goals[:, 0] < 35 * 0.2).all()


def test_goals_keep_within_bounds():
    """As the world ends at a height of 2.5 m and at x = 6 m of this map."""
    bounds = [[-1.0, -9.0, 1.0], [6.0, 99.0, 2.5]]
    goals, everywhere = (
        {*map(tuple, trials_in(FREE, 10_000, 0, bounds=box).goals)} for box in (bounds, None)
    )
    assert goals == {(x, y, z) for x, y, z in everywhere if x <= 6 and 1 <= z <= 2.5}
    assert 0 < len(goals) < len(everywhere)


CAREFUL = PlanConfig(planner="careful")


def planned(blocked, field, goal, risk=None):
    """The path, and the voxels that it meets, counted in C order."""
    _, path = plan_trial(blocked, field, risk, goal, GRID, CAREFUL)
    return path, np.empty(0, int) if path is None else met(path, GRID)


def test_occupied_voxels_are_never_entered():
    paths = 0
    for seed in range(20):
        occupied = scattered(seed)
        field = distance_field(occupied, GRID)
        for goal in trials_in(occupied, 4, seed).goals:
            path, voxels = planned(occupied, field, goal)
            paths += path is not None
            assert not occupied.reshape(-1)[voxels].any()
    assert paths > 60


def test_starts_may_be_held_occupied():
    around = FREE.copy()
    around[20, 20, 10] = True
    assert planned(around, FAR, EAST)[0] is not None
    assert plan_path(around, EAST, GRID, PLAN).reason == "start_blocked"


def test_likely_obstacles_are_gone_round():
    """A slab of a probability below the threshold, with a gap two metres off the straight line: the
    shortest path goes through the slab, the careful one through the gap."""
    risk = np.zeros(GRID.shape, np.float32)
    risk[28:32, :30] = 0.7
    shortest = met(plan_path(FREE, EAST, GRID, PLAN).waypoints, GRID)
    _, careful = planned(FREE, FAR, EAST, risk)
    highest = [risk.reshape(-1)[voxels].max() for voxels in (shortest, careful)]
    assert highest[0] > 0.5 >= highest[1]
