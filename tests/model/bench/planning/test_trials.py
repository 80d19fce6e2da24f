"""Trials: goals on the right faces, free and reachable in the truth, the same from the same
stream."""

import numpy as np
from numpy.testing import assert_array_equal

from scenegen.model.bench.planner import plan_path
from tests.model.bench.planning.test_measure import FREE, GRID, PLAN, trials_in


def test_goals_are_reachable_nodes_of_the_faces(rng):
    """Different ones, which follow from the stream alone; more of them begin alike."""
    truth = rng.random(GRID.shape) < 0.3
    truth[20, 20, 10] = False
    goals = trials_in(truth, 80, 0).goals
    voxels = np.floor(goals / 0.2).astype(int)
    lateral = np.isin(voxels[:, :2], (2, 38)).any(axis=1)
    assert (lateral | np.isin(voxels[:, 2], (1, 19))).all()
    assert not lateral.all()
    assert len(np.unique(voxels, axis=0)) == 80
    assert all(plan_path(truth, goal, GRID, PLAN).reason is None for goal in goals)
    assert_array_equal(trials_in(truth, 20, 0).goals, goals[:20])
    assert not np.array_equal(trials_in(truth, 80, 1).goals, goals)


def test_all_goals_are_tried_and_excluded_ones_counted():
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
    goals, everywhere = (
        {*map(tuple, trials_in(FREE, 10_000, 0, bounds=box).goals)} for box in (bounds, None)
    )
    assert goals == {(x, y, z) for x, y, z in everywhere if x <= 6 and 1 <= z <= 2.5}
    assert 0 < len(goals) < len(everywhere)
