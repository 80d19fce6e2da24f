"""Variants are what separate trials would give, and fates are told by the three maps."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import PlanConfig, StudyConfig
from scenegen.model.evaluation.planning.measure import draw_trials, run_trial
from scenegen.model.evaluation.study.planning import (
    COLUMNS,
    FATES,
    FIELDS,
    SEARCHES,
    fate,
    fields_of,
    run_variants,
    variants,
)
from scenegen.truth import distance_field
from tests.model.evaluation.planning.test_measure import EAST, FREE, GRID, filled, scattered

PLAN = PlanConfig()
STUDY = StudyConfig(clearance_weights=(0.3, 1.0, 10.0), safeties_m=(0.6, 1.0))


def test_every_variant_is_a_trial_of_its_own() -> None:
    """Against one whole trial a variant, without the paths and refinements that are kept here."""
    chosen = variants(PLAN, STUDY)
    assert len(chosen) == len(set(chosen)) == len(FIELDS) * (2 * (3 + 2 - 1) + 2)
    met = set()
    for seed in range(3):
        truth, occupied = scattered(seed), scattered(seed) & scattered(100 + seed)
        if seed == 2:
            occupied[20, 20, 10] = True  # where the start is
        tudf = distance_field(scattered(seed) & scattered(7), GRID)
        fields = fields_of(Prediction(occupied.astype(np.float32), tudf), occupied, GRID)
        goals = draw_trials(truth, GRID, PLAN, count=3, rng=np.random.default_rng(seed)).goals
        true = truth, distance_field(truth, GRID)
        found = run_variants(chosen, occupied, fields, true, truth, goals, GRID, PLAN)
        for g, goal in enumerate(goals):
            for v, variant in enumerate(chosen):
                edge_check, free_start = SEARCHES[variant.search]
                config = dataclasses.replace(
                    PLAN,
                    edge_check=edge_check,
                    free_start=free_start,
                    clearance_weight=variant.clearance_weight,
                    safety_m=variant.safety_m,
                )
                trial = run_trial(occupied, fields[variant.field], *true, goal, GRID, config)
                expected = [
                    trial.success,
                    trial.length_m,
                    trial.min_clearance_m,
                    trial.mean_clearance_m,
                ]
                np.testing.assert_array_equal(found[g, v, :-1], expected)
                met.add(FATES[int(found[g, v, -1])])
                blocked = seed == 2 and not free_start
                assert (trial.cause == "start_blocked") == blocked, "a free start is never blocked"
    assert {"reached", "no_path", "missed"} <= met


def test_without_predicted_distances_there_is_one_field() -> None:
    occupied = scattered(0)
    fields = fields_of(
        Prediction(occupancy_probability=occupied.astype(np.float32)), occupied, GRID
    )
    assert list(fields) == ["edt"]
    np.testing.assert_array_equal(fields["edt"], distance_field(occupied, GRID))
    chosen = variants(PLAN, STUDY)
    true = occupied, fields["edt"]
    found = run_variants(chosen, occupied, fields, true, occupied, EAST[None], GRID, PLAN)
    held = ~np.isnan(found[0, :, COLUMNS.index("fate")])
    assert [variant.field == "edt" for variant in chosen] == held.tolist()


WALL = filled((30,))  # nodes at 29 and 32


@pytest.mark.parametrize(
    ("occupied", "seen", "expected"),
    [
        (WALL, WALL, "known"),
        (FREE, WALL, "missed"),
        (FREE, FREE, "unseen"),
        (filled((29,)), WALL, "no_path"),
    ],
)
def test_a_failure_is_told_by_what_the_method_and_the_scan_knew(
    occupied: NDArray[np.bool_], seen: NDArray[np.bool_], expected: str
) -> None:
    truth = WALL, distance_field(WALL, GRID)
    trial = run_trial(occupied, distance_field(occupied, GRID), *truth, EAST, GRID, PLAN)
    assert fate(trial, occupied, seen) == expected
    assert trial.hit is None or np.unravel_index(trial.hit, GRID.shape)[0] == 30


def test_thresholds_do_not_touch_predicted_distances() -> None:
    said = Prediction(tudf=np.full(GRID.shape, 0.5, np.float32))
    np.testing.assert_array_equal(
        said.distance(Thresholds(), GRID), fields_of(said, FREE, GRID)["tudf"]
    )
