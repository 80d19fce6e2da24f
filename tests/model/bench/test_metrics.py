"""A metric is one entry: what the paper says of it, what the docs say, and what a report does with
one that is new."""

import re
from dataclasses import replace

import pytest

from scenegen.cli.bench import show_tables
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS, Metric
from tests.command_line import page
from tests.model.bench.test_bench import report_of

ALARMS = Metric("alarms", lambda s: s.share(s.alarms, s.hits + s.alarms), "occupancy")
NEVER = Metric("never", lambda s: float("nan"), "distance")
EVENNESS = Metric("evenness", lambda t: t.min_clearance_m / t.mean_clearance_m, "path")


def test_the_docs_name_every_metric():
    rows = [
        f"| `{name}` | {metric.label} | {metric.needs} | {metric.better} |"
        for name, metric in (METRICS | PLAN_METRICS).items()
    ]
    needs = r"(?:distance|occupancy|trial|path)"
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
    assert (tests["never"]["difference"], tests["never"]["p"]) == (None, 1.0)
    show_tables(report)
    assert {"iou", "alarms", "success", "evenness"} <= set(capsys.readouterr().out.split())
