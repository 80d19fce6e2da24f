"""A metric is one entry: what the paper says of it, what the docs say, and what a report does with
one that is new."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.distance import cdist

from lidarsim import GridSpec
from scenegen import Prediction
from scenegen.cli.bench import show_tables
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS, Metric, ScoredMap, chamfer
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
    nothing = {"mean": None, "std": None, "low": None, "high": None, "n": 0}
    assert row["never"] == nothing
    planned = report["planning"]["pillar"]["truth"]
    assert 0 < planned["evenness"]["mean"] <= 1
    assert {"evenness", "length"} < set(planned["successes"])
    tests = {test["metric"]: test for test in report["tests"]["pillar"]}
    assert "alarms" in tests
    assert (tests["never"]["difference"], tests["never"]["p"]) == (None, 1.0)
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
    """Voxels with a free neighbour that counts, metres."""
    beside = ndimage.binary_dilation(scored & ~mask)
    return GRID.voxel_m * np.argwhere(mask & scored & beside)


def test_chamfer_is_the_mean_way_between_surfaces(rng):
    """By all pairs of voxels; voxels that do not count change nothing."""
    masks, scored = rng.random((2, *GRID.shape)) < (0.6), rng.random(GRID.shape) < 0.9
    distances = cdist(*(surface_points(mask, scored) for mask in masks))
    expected = (distances.min(axis=0).mean() + distances.min(axis=1).mean()) / 2
    assert chamfer(judged(*masks, scored)) == pytest.approx(expected)
    masks ^= ~scored
    assert chamfer(judged(*masks, scored)) == pytest.approx(expected)


def test_chamfer_of_an_empty_surface_is_the_diagonal():
    none, some = np.zeros((2, *GRID.shape), bool)
    some[4, 4, 4] = True
    pairs = (none, none), (none, some), (some, none)
    diagonal = 0.5 * np.linalg.norm(GRID.shape)
    expected = pytest.approx([0, diagonal, diagonal])
    assert [chamfer(judged(*pair, ~none)) for pair in pairs] == expected


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
        "iou = max\nnumber = 3\ndef fails(m): return m.absent\ndef silent(m): pass\n"
        "from scenegen.model.bench.metrics import Metric\nup = Metric('up', abs, better='up')"
    )
    for name in ("iou", "number", "fails", "silent", "up"):
        words = ("--metric", f"odd:{name}", "--method", "returns")
        refuses(name, report_of, dataset, tmp_path, *words)
