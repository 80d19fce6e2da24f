"""Verdicts: what the paper's bold cells claim, and what a study's measurements say of it."""

import json
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.paper.claims import (
    ALL,
    PATIENCE,
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


def told(epochs, best=1.0):
    """What is told of a run of so many epochs that was best after `best` of them."""
    rows = [{"maps": 100 * best, "val_loss": 0.1}, {"maps": 100 * epochs, "val_loss": 0.2}]
    return {"samples": 100, "curve": rows}


def test_claims_are_the_bold_cells_against_each_other_row(monkeypatch):
    monkeypatch.setitem(METRICS, "of today", METRICS["iou"])
    found = claims()
    assert len(found) == len(set(found)) == 2 * 2 * (10 + 4)
    ties = [claim.best for claim in found if (claim.kind, claim.metric) == ("geometric", "mae")]
    assert sorted(ties) == ["proposed", "tudf"]  # .162 twice: each before `occ`
    for claim in found:
        table = PAPER["reconstruction" if claim.metric in METRICS else "planning"]
        names = {"tudf": "TUDF", "occ": "OCC", "proposed": "Proposed"}
        best, other = (
            table[claim.kind][names[name]][claim.metric][0] for name in (claim.best, claim.other)
        )
        better = {
            "higher": best > other,
            "lower": best < other,
            "nearer to 0": abs(best) < abs(other),
        }
        assert better[ALL[claim.metric].better]


def test_a_gain_is_positive_where_the_first_is_better(rng):
    base = rng.normal(0.5, 0.2, 200)
    for metric, sign in (("iou", 1), ("rmse", -1)):
        found = gain(measured({"a": base + 0.1, "b": base}, metric), metric, [("a", "b")])
        assert found.value == pytest.approx(sign * 0.1)
        assert found.error == pytest.approx(0, abs=1e-12)  # the same worlds are left out of both
        assert found.freedom == 39
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


def found(one, long=()):
    spreads = {("pillar", "iou"): seed_variance(losses(means(one), "iou"))}
    return decided([compared(CLAIM, one)], spreads, long)[0]


def test_intervals_hold_the_difference_of_methods_whatever_seeds_and_worlds_are_drawn(monkeypatch):
    """Seeds differ by more than worlds let means differ: without them the interval would be far too
    narrow."""
    monkeypatch.setattr("benchmarks.paper.claims.ALL", {"iou": METRICS["iou"]})
    rng, repeats = np.random.default_rng(1), 100
    every = [found(study(rng, 0.05, 0.02, training=0.02)) for _ in range(repeats)]
    held = np.mean([one["low"] <= 0.03 <= one["high"] for one in every])
    assert 0.93 <= held <= 0.985
    worlds_alone = np.mean(
        [abs(one["difference"] - 0.03) <= 2 * one["worlds_error"] for one in every]
    )
    assert worlds_alone < 0.6
    equal = [found(study(rng, 0.02, 0.02, training=0.02))["verdict"] for _ in range(50)]
    assert np.mean([verdict != "undecided" for verdict in equal]) < 0.09


def test_only_runs_as_long_as_the_paper_s_refute(rng):
    better, worse, alike = (study(rng, ours, 0.5, training=0.002) for ours in (0.6, 0.4, 0.501))
    assert (found(better)["verdict"], found(alike)["verdict"]) == ("confirmed", "undecided")
    runs = [f"{name}-s{seed}" for name in ("occ", "proposed") for seed in (0, 1)]
    assert found(worse)["verdict"] == found(worse, tuple(runs[:3]))["verdict"] == "contradicted"
    assert found(worse, tuple(runs))["verdict"] == "refuted"
    assert waited(told(4)) == 3
    assert waited(told(PATIENCE + 3, best=3)) == PATIENCE


def whole():
    """A study of both kinds, as it is before it is judged."""
    rng = np.random.default_rng(0)
    several = []
    for kind in PAPER["planning"]:
        base = study(rng, 0.6, 0.5, training=0.005)
        rows = {
            name: {metric: row["iou"] + 0.01 * n for n, metric in enumerate(ALL)}
            for name, row in base.rows.items()
        }
        several.append(bench_of(kind, rows, base.worlds_of("iou")))
    runs = {name: told(4) for name in several[0].rows}
    return {"runs": runs, "means": {one.kind: means(one) for one in several}, **asked(several)}


def test_verdicts_follow_from_the_file(tmp_path, monkeypatch):
    first, file = judged(whole()), tmp_path / "study.json"
    assert len(first["claims"]) == len(claims())
    assert {one["verdict"] for one in first["claims"]} == {"confirmed", "contradicted"}
    counted = Counter(one["question"] for one in first["claims"])
    for question, said in first["verdicts"].items():
        assert sum(said["claims"].values()) == counted[question] > 0
    agreeing = [claim | {"verdict": "refuted"} for claim in first["claims"]]
    assert {one["verdict"] for one in answers(agreeing).values()} == {"refuted"}
    file.write_text(json.dumps(first))
    monkeypatch.setitem(ALL, "of tomorrow", METRICS["iou"])  # which the file has not
    assert judged(json.loads(file.read_text())) == json.loads(json.dumps(first))
