"""The careful planner keeps to its map."""

import numpy as np

from scenegen.model.bench.planner import plan_path
from scenegen.model.bench.trials import met, plan_trial
from scenegen.model.config import PlanConfig
from scenegen.truth import distance_field
from tests.model.bench.planning.test_measure import (
    EAST,
    FAR,
    FREE,
    GRID,
    PLAN,
    scattered,
    trials_in,
)

CAREFUL = PlanConfig(planner="careful")


def planned(blocked, field, goal, risk=None):
    """What A* finds, the path, and the voxels that it meets, counted in C order."""
    plan, path = plan_trial(blocked, field, risk, goal, GRID, CAREFUL)
    return plan, path, np.empty(0, int) if path is None else met(path, GRID)


def test_occupied_voxels_are_never_entered():
    paths = 0
    for seed in range(20):
        occupied = scattered(seed)
        field = distance_field(occupied, GRID)
        for goal in trials_in(occupied, 4, seed).goals:
            _, path, voxels = planned(occupied, field, goal)
            paths += path is not None
            assert not occupied.reshape(-1)[voxels].any()
    assert paths > 60


def test_starts_may_be_held_occupied():
    around = np.zeros(GRID.shape, bool)
    around[tuple(edge // 2 for edge in GRID.shape)] = True
    assert planned(around, FAR, EAST)[1] is not None
    assert plan_path(around, EAST, GRID, PLAN).reason == "start_blocked"


def test_likely_obstacles_are_gone_round():
    """A slab of a probability below the threshold, with a gap two metres off the straight line: the
    shortest path goes through the slab, the careful one through the gap."""
    risk = np.zeros(GRID.shape, np.float32)
    risk[28:32, :30] = 0.7
    shortest = met(plan_path(FREE, EAST, GRID, PLAN).waypoints, GRID)
    *_, careful = planned(FREE, FAR, EAST, risk)
    highest = [risk.reshape(-1)[voxels].max() for voxels in (shortest, careful)]
    assert highest[0] > 0.5 >= highest[1]
