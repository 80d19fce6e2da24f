"""A metric is one entry: what the paper says of it, what the docs say, and what a report does with
one that is new."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from lidarsim import GridSpec
from scenegen.cli.bench import show_tables
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS, Metric, ScoredMap, chamfer, measure
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from tests.command_line import example, page
from tests.model.bench.test_bench import report_of
from tests.refusals import refuses

ALARMS = Metric("alarms", lambda s: s.share(s.alarms, s.hits + s.alarms), "occupancy")
NEVER = Metric("never", lambda s: float("nan"), "distance")
EVENNESS = Metric("evenness", lambda t: t.min_clearance_m / t.mean_clearance_m, "path")


def test_the_docs_name_every_metric():
    rows = [
        f"| `{name}` | {metric.label} | {metric.needs} | {metric.better} |"
        for name, metric in (METRICS | PLAN_METRICS).items()
    ]
    needs = r"(?:distance|occupancy|map|trial|path)"
    pattern = rf"^\| `\w+` \| [^|]+ \| {needs} \| [^|]+ \|$"
    assert re.findall(pattern, page("metrics.md"), re.M) == rows


def test_new_metrics_are_in_every_table(dataset, tmp_path, monkeypatch, capsys, undrawn):
    """And where nothing was measured, a report is JSON all the same."""
    for table, metric in ((METRICS, ALARMS), (METRICS, NEVER), (PLAN_METRICS, EVENNESS)):
        metric = replace(metric, better="lower", tested=("map",))
        monkeypatch.setitem(table, metric.title, metric)
    report = report_of(dataset, tmp_path, names=("conservative", "truth"))
    row = report["reconstruction"]["pillar"]["conservative"]
    assert row["alarms"]["mean"] == pytest.approx(1 - row["precision"]["mean"]) != 0
    assert row["by_class"]["occluded"]["alarms"]["n"]
    planned = report["planning"]["pillar"]["truth"]
    assert 0 < planned["evenness"]["mean"] <= 1
    assert {"evenness", "length"} < set(planned["successes"])
    tests = {test["metric"]: test for test in report["tests"]["pillar"]}
    assert "alarms" in tests
    nothing = dict.fromkeys(("mean", "std", "low", "high")) | {"n": 0}
    assert report["reconstruction"]["pillar"]["truth"]["never"] == nothing
    assert tests["never"]["difference"] is None
    assert tests["never"]["p"] == 1.0
    show_tables(report)
    assert {"iou", "alarms", "success", "evenness"} <= set(capsys.readouterr().out.split())


GRID = GridSpec(shape=(9, 8, 7), voxel_m=0.5)


def judged(occupied, truth, scored):
    return ScoredMap(
        prediction=Prediction(occupancy_probability=occupied.astype(np.float32)),
        truth={"occupancy": truth},
        grid=GRID,
        thresholds=Thresholds(),
        scored=scored,
    )


def surface_points(mask, scored):
    """Voxel by voxel: those with a free neighbour that counts, metres."""
    points = []
    for voxel in np.argwhere(mask & scored):
        beside = voxel + np.vstack([np.eye(3, dtype=int), -np.eye(3, dtype=int)])
        inside = beside[((beside >= 0) & (beside < mask.shape)).all(axis=1)]
        if any(scored[tuple(near)] and not mask[tuple(near)] for near in inside):
            points.append(GRID.voxel_m * voxel)
    return points


def test_chamfer_is_the_mean_way_between_surfaces(rng):
    """By all pairs of voxels; voxels that do not count change nothing."""
    masks, scored = rng.random((2, *GRID.shape)) < (0.6), rng.random(GRID.shape) < 0.9
    distances = cdist(*(surface_points(mask, scored) for mask in masks))
    expected = (distances.min(axis=0).mean() + distances.min(axis=1).mean()) / 2
    assert chamfer(judged(*masks, scored)) == pytest.approx(expected)
    masks ^= ~scored
    assert chamfer(judged(*masks, scored)) == pytest.approx(expected)


def test_chamfer_of_an_empty_surface_is_the_diagonal():
    none, some = np.zeros(GRID.shape, bool), np.zeros(GRID.shape, bool)
    some[4, 4, 4] = True
    scored, diagonal = np.ones(GRID.shape, bool), 0.5 * np.hypot(np.hypot(9, 8), 7)
    assert chamfer(judged(none, none, scored)) == 0
    for pair in ((none, some), (some, none)):
        assert chamfer(judged(*pair, scored)) == pytest.approx(diagonal)


@pytest.mark.parametrize("answer", [None, "much", np.ones(3)])
def test_a_metric_that_gives_no_number_is_refused(answer):
    full = np.ones(GRID.shape, bool)
    truth = {"occupancy": full, "tudf": np.zeros(GRID.shape, np.float32)}
    case = replace(judged(full, full, full), truth=truth)
    refuses(answer, measure, case, {"mine": Metric("mine", lambda case: answer)})


def test_a_metric_of_ones_own_stands_in_every_report(dataset, tmp_path, standing):
    (standing / "my_metrics.py").write_text(example("metrics.md", "# my_metrics.py"))
    words = ("--metric", "my_metrics:covered", "--metric", "my_metrics:height_error")
    report = report_of(dataset, tmp_path, *words, names=("returns", "truth"))
    returns, truth = report["reconstruction"]["pillar"].values()
    assert 0 < returns["covered"]["mean"] < truth["covered"]["mean"] == 1
    assert returns["height_error"]["mean"] <= 0 == truth["height_error"]["mean"]
    assert "covered" not in returns["unobserved"]
    assert "height error, m" in (tmp_path / "report.md").read_text()
    (standing / "odd.py").write_text(
        "iou = max\nnumber = 3\ndef fails(m): return m.absent\n"
        "from scenegen.model.bench.metrics import Metric\nup = Metric('up', abs, better='up')"
    )
    for name in ("iou", "number", "fails", "up"):
        words = ("--metric", f"odd:{name}", "--method", "returns")
        refuses(name, report_of, dataset, tmp_path, *words)
