"""Trials are judged in the truth: by a slow reference on random maps, and by hand on small ones."""

import itertools

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from lidarsim import GridSpec
from scenegen.model.config import PlanConfig
from scenegen.model.evaluation.planning.astar import Lattice, plan_path
from scenegen.model.evaluation.planning.measure import draw_trials, run_trial
from scenegen.model.evaluation.planning.refine import refine
from scenegen.truth import distance_field

GRID = GridSpec(shape=(40, 40, 20))
LATTICE = Lattice(
    GRID, 3
)  # nodes at voxels 2, 5 ... 38 in x and y, at 1, 4 ... 19 in z; the start is (20, 20, 10)
EAST = LATTICE.centres([12, 6, 3])  # voxel (38, 20, 10): straight along x
FREE = np.zeros(GRID.shape, bool)
FAR = np.full(GRID.shape, 2.0, np.float32)


def filled(*slices):
    occupied = FREE.copy()
    for part in slices:
        occupied[part] = True
    return occupied


def trial(pred, truth, goal=EAST, **parameters):
    config = PlanConfig(**parameters)  # type: ignore[arg-type]
    fields = distance_field(pred, GRID), distance_field(truth, GRID)
    return run_trial(pred, fields[0], truth, fields[1], goal, GRID, config)


def scattered(seed):
    """Random pillars and blocks, free around the start."""
    rng = np.random.default_rng(seed)
    occupied = FREE.copy()
    for low in rng.integers(0, (38, 38, 16), (25, 3)):
        x, y, z = low
        occupied[x : x + 2, y : y + 2, z : z + rng.integers(2, 20)] = True
    occupied[18:23, 18:23] = False
    return occupied


def test_measurements_are_those_of_a_slow_reference():
    """Every leg cut into pieces of at most 0.05 m, read by scipy, averaged along the path."""
    axes = [(np.arange(n) + 0.5) * 0.2 for n in GRID.shape]
    config = PlanConfig()
    outcomes = set()
    for seed in range(12):
        truth, pred = scattered(seed), scattered(seed) & scattered(100 + seed)
        tudf, tudf_pred = distance_field(truth, GRID), distance_field(pred, GRID)
        read = RegularGridInterpolator(
            axes, tudf.astype(float), bounds_error=False, fill_value=None
        )
        for goal in draw_trials(
            truth, GRID, config, count=5, rng=np.random.default_rng(seed)
        ).goals:
            result = run_trial(pred, tudf_pred, truth, tudf, goal, GRID, config)
            initial, _ = plan_path(pred, goal, GRID, config)
            path = refine(initial, tudf_pred, GRID, config)
            clear = True
            distances, weights = [], []
            for a, b in itertools.pairwise(path):
                count = int(np.ceil(np.linalg.norm(b - a) / 0.05 - 1e-9))
                points = a + (b - a) * (np.arange(count + 1) / count)[:, None]
                voxels = tuple(np.floor(points / 0.2).astype(int).T)
                clear &= not truth[voxels].any()
                found = read(points)
                distances.append((found[1:] + found[:-1]) / 2)
                weights.append(np.full(count, np.linalg.norm(b - a) / count))
                assert result.min_clearance_m <= found.min() + 1e-9
            assert result.success == clear
            assert result.length_m == pytest.approx(
                np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
            )
            mean = np.average(np.concatenate(distances), weights=np.concatenate(weights))
            assert result.mean_clearance_m == pytest.approx(mean, abs=1e-9)
            assert result.min_clearance_m <= result.mean_clearance_m <= 2.0
            assert result.success == (result.cause is None)
            outcomes.add(result.cause)
    assert {None, "initial_collides"} <= outcomes


def test_a_perfect_prediction_plans_like_the_truth():
    """What is excluded in the truth aside, it always finds a path; with the edge check, and before
    refinement, the whole of it is free."""
    for seed in range(12):
        truth = scattered(seed)
        trials = draw_trials(
            truth, GRID, PlanConfig(edge_check=True), count=8, rng=np.random.default_rng(seed)
        )
        for goal in trials.goals:
            checked = trial(truth, truth, goal, edge_check=True, iterations=0)
            assert checked.success
            unchecked = trial(truth, truth, goal, iterations=0)
            assert unchecked.length_m <= checked.length_m + 1e-9
            assert trial(truth, truth, goal).cause in (
                None,
                "initial_collides",
                "refined_into_obstacle",
            )


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (1, 1, 0), (-1, 1, 1)])
def test_an_empty_prediction_goes_straight_and_fails_where_the_truth_blocks(direction):
    """Along an axis or a diagonal, where the lattice allows a straight path."""
    nodes = 3
    goal = LATTICE.centres(LATTICE.start + nodes * np.array(direction))
    for seed in range(8):
        truth = np.random.default_rng(seed).random(GRID.shape) < 0.04
        result = run_trial(FREE, FAR, truth, distance_field(truth, GRID), goal, GRID, PlanConfig())
        passed = [
            tuple(np.array((20, 20, 10)) + n * np.array(direction)) for n in range(3 * nodes + 1)
        ]
        assert result.length_m == pytest.approx(0.6 * nodes * np.linalg.norm(direction))
        assert result.success == (not any(truth[voxel] for voxel in passed))
        assert result.cause == (None if result.success else "initial_collides")


def test_a_thin_obstacle_between_waypoints_is_seen_by_the_samples():
    result = trial(FREE, filled((30,)))  # nodes at 29 and 32
    assert (result.success, result.cause) == (False, "initial_collides")


def test_an_imagined_obstacle_can_push_the_path_into_a_real_one():
    """A wall is imagined two voxels beside a free way; an obstacle stands a voxel off on the
    other."""
    imagined = filled((slice(22, 37), 22))
    real = filled((slice(27, 33), slice(16, 19)))
    result = trial(imagined, real)
    assert (result.success, result.cause) == (False, "refined_into_obstacle")
    assert result.length_m > 3.6
    assert trial(FREE, real).success


def test_refinement_can_save_a_path_that_collides_at_first():
    imagined = filled((slice(22, 37), 22))
    real = filled((30, 20, 10))
    assert trial(imagined, real, iterations=0).cause == "initial_collides"
    saved = trial(imagined, real)
    assert (saved.success, saved.cause) == (True, None)


def test_maps_of_another_shape_are_refused():
    for place, name in enumerate(("occupied", "tudf", "occupancy_truth", "tudf_truth")):
        maps = [FREE, FAR, FREE, FAR]
        maps[place] = maps[place][1:]
        with pytest.raises(ValueError, match=f"{name}: shape"):
            run_trial(maps[0], maps[1], maps[2], maps[3], EAST, GRID, PlanConfig())
