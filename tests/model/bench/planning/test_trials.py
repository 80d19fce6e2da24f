"""Trials: goals on the right faces, free and reachable in the truth, the same from the same
stream."""

import numpy as np
from numpy.testing import assert_array_equal

from scenegen.model.bench.planner import plan_path
from scenegen.model.config import PlanConfig
from tests.model.bench.planning.test_measure import FREE, GRID, trials_in


def scattered(seed, density):
    occupied = np.random.default_rng(seed).random(GRID.shape) < density
    occupied[20, 20, 10] = False
    return occupied


def test_goals_are_free_reachable_different_nodes_of_the_faces():
    truth, config = scattered(1, 0.3), PlanConfig()
    trials = trials_in(truth, 80, 0)
    assert trials.goals.shape == (80, 3)
    voxels = np.floor(trials.goals / 0.2).astype(int)
    assert not truth[tuple(voxels.T)].any()
    lateral = np.isin(voxels[:, :2], (2, 38)).any(axis=1)
    level = np.isin(voxels[:, 2], (1, 19))
    assert (lateral | level).all()
    assert (~lateral).any()
    assert len(np.unique(voxels, axis=0)) == 80
    assert all(plan_path(truth, goal, GRID, config).reason is None for goal in trials.goals)


def test_goals_follow_from_the_stream_alone_and_more_of_them_begin_alike():
    truth = scattered(2, 0.2)
    first, again, other, more = (
        trials_in(truth, count, seed) for seed, count in ((5, 20), (5, 20), (6, 20), (5, 40))
    )
    assert_array_equal(first.goals, again.goals)
    assert_array_equal(first.goals, more.goals[:20])
    assert first.excluded == again.excluded
    assert not np.array_equal(first.goals, other.goals)


def test_every_goal_left_is_found_and_the_rest_are_counted_by_reason():
    """A wall cuts off the layer x = 38, all of 13 x 7 goals; one of the others lies in an
    obstacle."""
    truth = FREE.copy()
    truth[35] = True
    truth[2, 2, 1] = True
    trials = trials_in(truth, 10_000, 0)
    layer = 13 * 7
    rim = 13 * 13 * 7 - 11 * 11 * 5  # nodes of the outermost layer
    blocked = layer - 11 * 5 + 1
    assert len(trials.goals) == rim - layer - blocked
    assert trials.excluded == {"no_path": layer, "goal_blocked": blocked}
    assert (trials.goals[:, 0] < 35 * 0.2).all()


def test_goals_keep_within_bounds():
    """As the world ends at a height of 2.5 m and at x = 6 m of this map."""
    bounds = [[-1.0, -9.0, 1.0], [6.0, 99.0, 2.5]]
    goals, everywhere = (trials_in(FREE, 10_000, 0, bounds=given).goals for given in (bounds, None))
    x, _, z = everywhere.T
    inside = everywhere[(x <= 6) & (z >= 1) & (z <= 2.5)]
    assert 0 < len(goals) < len(everywhere)
    assert {*map(tuple, goals)} == {*map(tuple, inside)}
