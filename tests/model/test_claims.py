"""Verdicts: what the paper's bold cells claim, and what a bench's results say of it."""

import itertools
import json
from collections import Counter
from typing import Any

import numpy as np
import pytest

from scenegen.model.evaluation import paper
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.reproduce.claims import Claim, Contrast, answers, claims, contrasts, judge, judged, verdict
from scenegen.model.reproduce.runs import RUNS

WORLDS = np.repeat(np.arange(40), 5)


def row(values: np.ndarray, metric: str = "iou") -> Any:
    """A method whose `metric` on every map is as given, and whose others are 0."""
    found = np.zeros((len(values), 1, len(METRICS)))
    found[:, 0, list(METRICS).index(metric)] = values
    return type("Row", (), {"reconstruction": found, "trials": ()})()


def result(kind: str = "pillar", **rows: Any) -> Any:
    named = {name.replace("_", "-"): one for name, one in rows.items()}
    return type("Result", (), {"kind": kind, "worlds": WORLDS, "trial_worlds": WORLDS, "methods": named})()


def test_claims_are_the_bold_cells_against_each_other_row() -> None:
    found = claims()
    assert len(found) == len(set(found)) == 2 * 2 * (10 + 4) - 1  # MAE of geometric maps is .162 twice
    assert Claim(kind="geometric", metric="success", best="proposed", other="occ") in found
    assert Claim(kind="pillar", metric="length", best="occ", other="proposed") in found
    assert Claim(kind="pillar", metric="bias", best="tudf", other="occ") in found  # .016 is nearer to 0
    for claim in found:
        table = paper.RECONSTRUCTION if claim.metric in METRICS else paper.PLANNING
        names = {"tudf": "TUDF", "occ": "OCC", "proposed": "Proposed"}
        best, other = (table[claim.kind][names[name]][claim.metric][0] for name in (claim.best, claim.other))
        better = {"higher": best > other, "lower": best < other, "nearer to 0": abs(best) < abs(other)}
        assert better[(METRICS | PLAN_METRICS)[claim.metric].better]


@pytest.mark.parametrize(
    ("metric", "shift", "sign"), [("iou", 0.1, 1), ("iou", -0.1, -1), ("rmse", 0.1, -1), ("rmse", -0.1, 1)]
)
def test_a_contrast_is_positive_where_the_claim_holds(metric: str, shift: float, sign: int) -> None:
    rng = np.random.default_rng(0)
    base = rng.normal(0.5, 0.2, 200)
    both = result(proposed_s0=row(base + shift, metric), occ_s0=row(base, metric))
    (found,) = judge(Claim(kind="pillar", metric=metric, best="proposed", other="occ"), both, seeds=(0, 1), seed=0)
    assert found.difference == pytest.approx(sign * 0.1)
    assert found.sign == sign
    assert found.low == pytest.approx(found.high)  # worlds are drawn alike for both


def test_bias_is_judged_by_its_distance_from_0() -> None:
    both = result(tudf_s0=row(np.full(200, -0.02), "bias"), occ_s0=row(np.full(200, 0.2), "bias"))
    (found,) = judge(Claim(kind="pillar", metric="bias", best="tudf", other="occ"), both, seeds=(0,), seed=0)
    assert found.difference == pytest.approx(0.18)


def test_the_interval_holds_the_truth_19_times_of_20() -> None:
    """Worlds differ by 0.1, maps of a world by little: an interval over maps would be far too narrow."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(200):
        gain = 0.02 + rng.normal(0, 0.1, 40)[WORLDS] + rng.normal(0, 0.01, 200)
        both = result(proposed_s0=row(gain), occ_s0=row(np.zeros(200)))
        (found,) = judge(Claim(kind="pillar", metric="iou", best="proposed", other="occ"), both, seeds=(0,), seed=0)
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 0.02 <= found.high
    assert 178 <= held <= 198


def contrast(low: float | None, high: float | None) -> Contrast:
    return Contrast(seed=0, difference=0.0, low=low, high=high)


def test_a_verdict_needs_two_seeds_that_agree() -> None:
    above, below, across, none = contrast(0.1, 0.2), contrast(-0.2, -0.1), contrast(-0.1, 0.1), contrast(None, None)
    assert verdict([above, above]) == "confirmed"
    assert verdict([below, below, below]) == "refuted"
    for pair in itertools.product((above, below, across, none), repeat=2):
        if pair not in ((above, above), (below, below)):
            assert verdict(pair) == "undecided"
    assert verdict([above]) == verdict([]) == "undecided"


def test_planning_is_judged_by_trials_and_paths_by_those_that_have_one() -> None:
    def trial(success: bool, length: float) -> Any:
        return type("Trial", (), {"success": success, "length_m": length})()

    def method(successes: np.ndarray, lengths: np.ndarray) -> Any:
        return type("Row", (), {"trials": tuple(map(trial, successes, lengths))})()

    won = np.arange(200) % 2 == 0
    half = np.where(won, 9.0, np.nan)
    both = result(occ_s0=method(won, half), proposed_s0=method(np.ones(200, bool), np.full(200, 10.0)))
    (length,) = judge(Claim(kind="pillar", metric="length", best="occ", other="proposed"), both, seeds=(0,), seed=0)
    assert length.difference == pytest.approx(1.0)
    (success,) = judge(Claim(kind="pillar", metric="success", best="proposed", other="occ"), both, seeds=(0,), seed=0)
    assert success.difference == pytest.approx(0.5)


def test_verdicts_are_plain_json_and_questions_count_them() -> None:
    rng = np.random.default_rng(0)
    rows = {
        f"{name}_s{seed}": row(rng.normal(at, 0.05, 200))
        for name, at in (("occ", 0.5), ("proposed", 0.6))
        for seed in (0, 1)
    }
    for one in rows.values():
        one.trials = (
            type("Trial", (), dict.fromkeys(("success", "length_m", "min_clearance_m", "mean_clearance_m"), 1.0))(),
        ) * 200
    found = [
        claim for kind in ("pillar", "geometric") for claim in judged(result(kind, **rows), claims(), seeds=(0, 1))
    ]
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert len(found) == len(claims())
    held = {claim["verdict"] for claim in found if (claim["metric"], claim["other"]) == ("iou", "occ")}
    assert held == {"confirmed"}
    answered = answers(found)
    counted = Counter(one["question"] for one in found)
    for question, said in answered.items():
        assert sum(said["claims"].values()) == counted[question] > 0
        assert said["verdict"] == "undecided"
    agreeing = [claim | {"verdict": "refuted"} for claim in found]
    assert {one["verdict"] for one in answers(agreeing).values()} == {"refuted"}


def test_runs_that_no_claim_is_about_are_compared_with_the_one_they_name() -> None:
    rng = np.random.default_rng(0)
    base = rng.normal(0.5, 0.2, 200)
    rows = {"occ-short": row(base), "occ-wide": row(base + 0.05)}
    both = type("Result", (), {"kind": "pillar", "worlds": WORLDS, "trial_worlds": WORLDS, "methods": rows})()
    runs = [run for run in RUNS if run.name in ("occ-short", "occ-wide", "dual")]
    found = {one["metric"]: one for one in contrasts(both, runs, seed=0) if one["metric"] != "success"}
    assert {one["run"] for one in found.values()} == {"occ-wide"}
    assert found["iou"]["difference"] == pytest.approx(0.05)
    assert found["near_rmse"]["difference"] == 0
