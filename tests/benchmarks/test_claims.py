"""Verdicts: what the paper's bold cells claim, and what a study's measurements say of it."""

import json
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.paper.claims import (
    ALL,
    PATIENCE,
    QUESTIONS,
    Claim,
    answers,
    asked,
    claims,
    compared,
    decided,
    gain,
    judged,
    losses,
    means,
    seed_variance,
    waited,
)
from scenegen.model.bench.metrics import METRICS
from scenegen.model.bench.report import PAPER
from tests.command_line import ROOT

WORLDS = np.repeat(np.arange(40), 5)
CLAIM = Claim(kind="pillar", metric="iou", best="proposed", other="occ")


def measured(values, metric="iou", kind="pillar", worlds=WORLDS):
    """Rows whose `metric` on every map, or trial, is as given, and whose others are 0."""
    nothing = dict.fromkeys(ALL, np.zeros(len(worlds)))
    rows = {name.replace("_", "-"): nothing | {metric: one} for name, one in values.items()}
    return bench_of(kind, rows, worlds)


def bench_of(kind, rows, worlds):
    """What of a `DatasetResult` is judged: rows by name and metric, and the worlds of all."""
    methods = {
        name: SimpleNamespace(values=lambda metric, region=0, row=row: row[metric])
        for name, row in rows.items()
    }
    return SimpleNamespace(kind=kind, rows=rows, methods=methods, worlds_of=lambda metric: worlds)


def test_claims_are_the_bold_cells_against_each_other_row(monkeypatch):
    monkeypatch.setitem(METRICS, "of today", METRICS["iou"])
    every = claims()
    assert len(every) == len(set(every)) == 2 * 2 * (10 + 4)
    ties = [claim.best for claim in every if (claim.kind, claim.metric) == ("geometric", "mae")]
    assert sorted(ties) == ["proposed", "tudf"]  # .162 twice: each before `occ`
    for claim in every:
        table = PAPER["reconstruction" if claim.metric in METRICS else "planning"][claim.kind]
        names = {"tudf": "TUDF", "occ": "OCC", "proposed": "Proposed"}
        best, other = (table[names[row]][claim.metric][0] for row in (claim.best, claim.other))
        match ALL[claim.metric].better:
            case "higher":
                assert best > other
            case "lower":
                assert best < other
            case _:
                assert abs(best) < abs(other)


def test_a_gain_is_positive_where_the_first_is_better(rng):
    base = rng.normal(0.5, 0.2, 200)
    for metric, sign in (("iou", 1), ("rmse", -1)):
        estimate = gain(measured({"a": base + 0.1, "b": base}, metric), metric, [("a", "b")])
        assert estimate.value == pytest.approx(sign * 0.1)
        assert estimate.error == pytest.approx(0, abs=1e-12)  # the same worlds are left out of both
        assert estimate.freedom == 39
    both = measured({"a": np.full(200, -0.02), "b": np.full(200, 0.2)}, "bias")
    assert gain(both, "bias", [("a", "b")]).value == pytest.approx(0.18)  # its distance from 0


def test_paths_are_compared_where_both_have_one():
    won = np.arange(200) % 2 == 0
    short = measured({"a": np.where(won, 9.0, np.nan), "b": np.where(won, 8.0, 20.0)}, "length")
    assert gain(short, "length", [("a", "b")]).value == pytest.approx(5.0)
    assert gain(short, "length", [("a", "b")], common=True).value == pytest.approx(-1.0)
    none = measured({"a": np.full(200, np.nan), "b": np.ones(200)}, "length")
    assert gain(none, "length", [("a", "b")], common=True).chance is None


def study(rng, ours, theirs, *, seeds=2, training=0.0):
    """Four methods in 40 worlds, which are unlike for each network, as training seeds are by
    `training`."""
    rows = {}
    for name, mean in (("proposed", ours), ("occ", theirs), ("tudf", 0.0), ("columns", 0.0)):
        for seed in range(seeds):
            worlds = rng.normal(0, 0.02, 40)[WORLDS]
            rows[f"{name}_s{seed}"] = (
                mean + rng.normal(0, training) + worlds + rng.normal(0, 0.02, 200)
            )
    return measured(rows)


def decision(measured, long=()):
    spreads = {("pillar", "iou"): seed_variance(losses(means(measured), "iou"))}
    return decided([compared(CLAIM, measured)], spreads, long)[0]


def test_intervals_hold_the_difference_of_methods_whatever_seeds_and_worlds_are_drawn(monkeypatch):
    """Seeds differ by more than worlds let means differ: without them the interval would be far too
    narrow."""
    monkeypatch.setattr("benchmarks.paper.claims.ALL", {"iou": METRICS["iou"]})
    rng, repeats = np.random.default_rng(1), 100
    every = [decision(study(rng, 0.05, 0.02, training=0.02)) for _ in range(repeats)]
    held = np.mean([claim["low"] <= 0.03 <= claim["high"] for claim in every])
    assert 0.93 <= held <= 0.985
    errors = [(abs(claim["difference"] - 0.03), claim["worlds_error"]) for claim in every]
    assert np.mean([error <= 2 * worlds_alone for error, worlds_alone in errors]) < 0.6
    equal = [decision(study(rng, 0.02, 0.02, training=0.02))["verdict"] for _ in range(50)]
    assert np.mean([verdict != "undecided" for verdict in equal]) < 0.09


def test_only_long_runs_refute(rng):
    """Those as long as the paper's."""
    better, worse, alike = (study(rng, ours, 0.5, training=0.002) for ours in (0.6, 0.4, 0.501))
    assert decision(better)["verdict"] == "confirmed"
    assert decision(alike)["verdict"] == "undecided"
    runs = [f"{name}-s{seed}" for name in ("occ", "proposed") for seed in (0, 1)]
    assert decision(worse, runs[:3])["verdict"] == "contradicted"
    assert decision(worse, runs)["verdict"] == "refuted"


@pytest.mark.parametrize(("best", "last"), [(1, 4), (3, PATIENCE + 3)])
def test_runs_wait_after_their_best_epoch(best, last):
    rows = [{"maps": 100 * best, "val_loss": 0.1}, {"maps": 100 * last, "val_loss": 0.2}]
    assert waited({"samples": 100, "curve": rows}) == last - best


def test_claims_are_asked_of_their_kind(rng):
    """Paths again, where both have one."""
    questions = asked([study(rng, 0.6, 0.5)])
    kinds = {claim["kind"] for part in questions.values() for claim in part}
    assert kinds == {"pillar"}
    assert len(questions["claims"]) == len(claims()) / 2
    assert {claim["metric"] for claim in questions["paths"]} == {*QUESTIONS["Q3"][1]}


def test_verdicts_of_the_study_follow_from_its_file(monkeypatch):
    monkeypatch.setitem(ALL, "of tomorrow", METRICS["iou"])  # which the file has not
    stored = json.loads((ROOT / "docs" / "results" / "study.json").read_text(encoding="utf-8"))
    again = judged(stored)
    assert again["verdicts"] == stored["verdicts"]
    for part in ("claims", "beside", "paths"):
        for claim, expected in zip(again[part], stored[part], strict=True):
            assert claim["verdict"] == expected["verdict"]
            assert claim["low"] == pytest.approx(expected["low"], abs=1e-4)
    counts = Counter((claim["question"], claim["verdict"]) for claim in again["claims"])
    for question, answer in again["verdicts"].items():
        assert {(question, verdict): n for verdict, n in answer["claims"].items()} == {
            key: n for key, n in counts.items() if key[0] == question
        }
    agreeing = [claim | {"verdict": "refuted"} for claim in again["claims"]]
    assert {answer["verdict"] for answer in answers(agreeing).values()} == {"refuted"}
