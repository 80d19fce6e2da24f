"""Verdicts: what the paper's bold cells claim, and what a bench's results say of it."""

import json
from collections import Counter
from typing import Any

import numpy as np
import pytest

from scenegen.model.evaluation import paper
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.reproduce.claims import Claim, Contrast, Draws, answers, claims, contrasts, judged
from scenegen.model.reproduce.runs import RUNS

WORLDS = np.repeat(np.arange(40), 5)


@pytest.fixture(autouse=True)
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scenegen.model.reproduce.claims.DRAWS", 1000)


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
    assert len(found) == len(set(found)) == 2 * 2 * (10 + 4)
    ties = [claim.best for claim in found if (claim.kind, claim.metric) == ("geometric", "mae")]
    assert sorted(ties) == ["proposed", "tudf"]  # .162 twice: each before `occ`, neither before the other
    assert Claim(kind="geometric", metric="success", best="proposed", other="occ") in found
    assert Claim(kind="pillar", metric="length", best="occ", other="proposed") in found
    assert Claim(kind="pillar", metric="bias", best="tudf", other="occ") in found  # .016 is nearer to 0
    for claim in found:
        table = paper.RECONSTRUCTION if claim.metric in METRICS else paper.PLANNING
        names = {"tudf": "TUDF", "occ": "OCC", "proposed": "Proposed"}
        best, other = (table[claim.kind][names[name]][claim.metric][0] for name in (claim.best, claim.other))
        better = {"higher": best > other, "lower": best < other, "nearer to 0": abs(best) < abs(other)}
        assert better[(METRICS | PLAN_METRICS)[claim.metric].better]


def gain(both: Any, metric: str, best: str = "proposed-s0", other: str = "occ-s0") -> Contrast:
    return Draws(both, 0).gain(metric, best, other)


@pytest.mark.parametrize(
    ("metric", "shift", "sign"), [("iou", 0.1, 1), ("iou", -0.1, -1), ("rmse", 0.1, -1), ("rmse", -0.1, 1)]
)
def test_a_contrast_is_positive_where_the_first_is_better(metric: str, shift: float, sign: int) -> None:
    rng = np.random.default_rng(0)
    base = rng.normal(0.5, 0.2, 200)
    found = gain(result(proposed_s0=row(base + shift, metric), occ_s0=row(base, metric)), metric)
    assert found.difference == pytest.approx(sign * 0.1)
    assert found.low == pytest.approx(found.high)  # worlds are drawn alike for both
    assert found.chance is not None
    assert found.chance < 0.01


def test_bias_is_judged_by_its_distance_from_0() -> None:
    both = result(tudf_s0=row(np.full(200, -0.02), "bias"), occ_s0=row(np.full(200, 0.2), "bias"))
    assert gain(both, "bias", "tudf-s0").difference == pytest.approx(0.18)


def test_the_interval_holds_the_truth_and_chance_is_as_often_small_as_it_says() -> None:
    """Worlds differ by 0.1, maps of a world by little: an interval over maps would be far too narrow."""
    rng, held, small = np.random.default_rng(1), 0, 0
    for _ in range(100):
        noise = rng.normal(0, 0.1, 40)[WORLDS] + rng.normal(0, 0.01, 200)
        found = gain(result(proposed_s0=row(noise), occ_s0=row(np.zeros(200))), "iou")
        assert found.low is not None
        assert found.high is not None
        assert found.chance is not None
        held += found.low <= 0 <= found.high
        small += found.chance <= 0.2
    assert 87 <= held <= 99  # of 95, less what 40 worlds take from a bootstrap
    assert 10 <= small <= 34  # of 20


def test_one_world_decides_nothing() -> None:
    both = result(proposed_s0=row(np.ones(200)), occ_s0=row(np.zeros(200)))
    both.worlds = np.zeros(200)
    assert gain(both, "iou") == Contrast(difference=1.0, low=None, high=None, chance=None)


def verdict(rows: dict[str, Any], asked: str = "iou") -> str:
    claim = Claim(kind="pillar", metric=asked, best="proposed", other="occ")
    (found,) = judged([Draws(result(**rows), 0)], [claim], (0, 1))
    assert len(found["pairs"]) == sum(name[0] == "o" for name in rows) * sum(name[0] == "p" for name in rows)
    return str(found["verdict"])


def test_a_verdict_needs_every_pair_of_two_seeds() -> None:
    rng = np.random.default_rng(3)

    def at(mean: float) -> Any:
        return row(mean + rng.normal(0, 0.05, 200))

    occ, better, worse = {"occ_s0": at(0.5), "occ_s1": at(0.51)}, at(0.6), at(0.4)
    assert verdict(occ | {"proposed_s0": better, "proposed_s1": better}) == "confirmed"
    assert verdict(occ | {"proposed_s0": worse, "proposed_s1": worse}) == "refuted"
    for second in (worse, at(0.505)):
        assert verdict(occ | {"proposed_s0": better, "proposed_s1": second}) == "undecided"
    assert verdict(occ | {"proposed_s0": better}) == "undecided"
    assert verdict({"occ_s0": at(0.5), "proposed_s0": better, "proposed_s1": better}) == "undecided"
    assert verdict({}) == "undecided"
    crossed = {"occ_s0": at(0.5), "proposed_s0": at(0.55), "occ_s1": at(0.6), "proposed_s1": at(0.65)}
    assert verdict(crossed) == "undecided"  # each seed has it so by itself, one cross pair has not


def test_planning_is_judged_by_trials_and_paths_by_those_that_have_one() -> None:
    def trial(success: bool, length: float) -> Any:
        return type("Trial", (), {"success": success, "length_m": length})()

    def method(successes: np.ndarray, lengths: np.ndarray) -> Any:
        return type("Row", (), {"trials": tuple(map(trial, successes, lengths))})()

    won = np.arange(200) % 2 == 0
    half = np.where(won, 9.0, np.nan)
    both = result(occ_s0=method(won, half), proposed_s0=method(np.ones(200, bool), np.full(200, 10.0)))
    assert gain(both, "length", "occ-s0", "proposed-s0").difference == pytest.approx(1.0)
    short = result(occ_s0=method(won, half), proposed_s0=method(np.ones(200, bool), np.where(won, 8.0, 20.0)))
    assert gain(short, "length", "occ-s0", "proposed-s0").difference == pytest.approx(5.0)
    on_both = Draws(short, 0).gain("length", "occ-s0", "proposed-s0", common=True)
    assert on_both.difference == pytest.approx(-1.0)  # its other paths are of trials where `occ` has none
    assert gain(both, "success").difference == pytest.approx(0.5)


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
    found = judged([Draws(result(kind, **rows), 0) for kind in ("pillar", "geometric")], claims(), (0, 1))
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
    found = {one["metric"]: one for one in contrasts(Draws(both, 0), runs) if one["metric"] != "success"}
    assert {one["run"] for one in found.values()} == {"occ-wide"}
    assert found["iou"]["difference"] == pytest.approx(0.05)
    assert found["near_rmse"]["difference"] == 0
