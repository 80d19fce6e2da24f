"""The careful planner keeps to its map, and the risk asked of it is the risk had."""

import dataclasses

import numpy as np
import pytest

from scenegen.model.calibration import UncertaintyError
from scenegen.model.config import PlanConfig
from scenegen.model.evaluation.calibrate import count_scores, path_risks
from scenegen.model.evaluation.planning.astar import plan_path
from scenegen.model.evaluation.planning.measure import judge, met, plan_trial
from scenegen.truth import distance_field
from tests.model.evaluation.planning.test_measure import (
    EAST,
    FAR,
    FREE,
    GRID,
    PLAN,
    scattered,
    trials_in,
)
from tests.model.uncertainty.test_fit import bounds_of

CAREFUL = PlanConfig(planner="careful")


def planned(blocked, field, goal, risk=None):
    """What A* finds, the path, and the voxels that it meets, counted in C order."""
    plan, path = plan_trial(blocked, field, risk, goal, GRID, CAREFUL)
    return plan, path, np.empty(0, int) if path is None else met(path, GRID)


def test_it_never_enters_what_its_map_holds_occupied():
    found = 0
    for seed in range(20):
        occupied = scattered(seed)
        field = distance_field(occupied, GRID)
        for goal in trials_in(occupied, 4, seed).goals:
            plan, path, voxels = planned(occupied, field, goal)
            found += path is not None
            assert not occupied.reshape(-1)[voxels].any()
            assert judge(plan, path, occupied, field, GRID).success == (path is not None)
    assert found > 60


def test_a_robot_may_start_where_its_map_holds_occupied():
    around = np.zeros(GRID.shape, bool)
    around[tuple(edge // 2 for edge in GRID.shape)] = True
    assert planned(around, FAR, EAST)[1] is not None
    assert plan_path(around, EAST, GRID, PLAN).reason == "start_blocked"


def test_it_goes_round_what_is_likely_occupied():
    """A slab of a probability below the threshold, with a gap two metres off the straight line: the
    shortest path goes through the slab, the careful one through the gap."""
    risk = np.zeros(GRID.shape, np.float32)
    risk[28:32] = 0.7
    risk[:, 30:] = 0.0
    shortest, _ = plan_path(FREE, EAST, GRID, PLAN)
    *_, voxels = planned(FREE, FAR, EAST, risk)
    assert shortest is not None
    assert risk.reshape(-1)[met(shortest, GRID)].max() > 0.5
    assert risk.reshape(-1)[voxels].max() <= 0.5


def test_the_risk_asked_is_the_risk_had(rng):
    """A method that sees all obstacles of a world shrunk alike, in some worlds to nothing:
    calibrated on some worlds, and given other ones."""
    shrunk_m, share = [0.0, 0.4, 0.8, 1.2, 1.6], [0.2] * 5

    def world(seed):
        truth = scattered(seed)
        tudf = distance_field(truth, GRID)
        return truth, np.minimum(tudf + rng.choice(shrunk_m, p=share), 2).astype(np.float32)

    def collisions(found, truth, said, seed):
        goals = trials_in(truth, 2, seed).goals
        lows = [found.low(said, None, risk) for risk in found.risks]
        voxels = [[planned(low <= 0, low, goal)[2] for goal in goals] for low in lows]
        return np.array([np.mean([truth.reshape(-1)[one].any() for one in row]) for row in voxels])

    known, new = [world(seed) for seed in range(80)], [world(seed) for seed in range(1000, 1080)]
    everywhere = np.ones(GRID.shape, bool)
    counts = [
        count_scores(said, None, distance_field(truth, GRID), everywhere, GRID)
        for truth, said in known
    ]
    found = bounds_of(counts, GRID, (0.7, 0.5, 0.4, 0.3, 0.1))
    promised = path_risks(
        np.array([collisions(found, *one, seed) for seed, one in enumerate(known)])
    )
    found = dataclasses.replace(found, path_risks=promised)
    had = np.array([collisions(found, *one, seed) for seed, one in enumerate(new)])
    error = had.std(axis=0) / len(new) ** 0.5
    asked, mean = (0.04, 0.1, 0.2), had.mean(axis=0)
    chosen = [found.risks.index(found.for_paths(risk)) for risk in asked]
    assert (mean[chosen] <= asked + 2 * error[chosen]).all(), (promised, mean)
    assert len(set(chosen)) > 1  # risk is what is chosen between
    assert mean[0] > 0.1
    with pytest.raises(UncertaintyError, match=r"promises down to 0\.0"):
        found.for_paths(0.001)
