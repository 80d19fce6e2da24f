"""A metric is one entry: what the paper says of it, what the docs say, and what a report does with
one that is new."""

import json
import re
from pathlib import Path

import pytest

from scenegen.model.commands.bench import show_tables
from scenegen.model.evaluation import paper
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS, Metric
from tests.model.evaluation.test_bench import report_of

DOCS = Path(__file__).parents[3] / "docs"


def test_the_papers_tables_have_the_metrics_that_say_so():
    for tables_of, metrics in ((paper.RECONSTRUCTION, METRICS), (paper.PLANNING, PLAN_METRICS)):
        for rows in tables_of.values():
            for row in rows.values():
                assert set(row) == {name for name, metric in metrics.items() if metric.paper}


def test_the_docs_name_every_metric():
    rows = [
        f"| `{name}` | {metric.label} | {metric.needs} | {metric.better} |"
        for name, metric in (METRICS | PLAN_METRICS).items()
    ]
    found = re.findall(
        r"^\| `\w+` \| [^|]+ \| (?:distance|occupancy|trial|path) \| [^|]+ \|$",
        text("bench.md"),
        re.M,
    )
    assert found == rows


def text(name):
    return (DOCS / name).read_text(encoding="utf-8")


def test_a_metric_that_the_paper_lacks_is_in_every_table(dataset, tmp_path, monkeypatch, capsys):
    alarms = Metric(
        title="alarms",
        of=lambda s: s.share(s.alarms, s.hits + s.alarms),
        needs="occupancy",
        better="lower",
        tested=("map",),
    )
    evenness = Metric(
        title="evenness",
        of=lambda t: t.min_clearance_m / t.mean_clearance_m,
        needs="path",
        better="higher",
    )
    monkeypatch.setitem(METRICS, "alarms", alarms)
    monkeypatch.setitem(PLAN_METRICS, "evenness", evenness)
    report = report_of(dataset, tmp_path, names=("conservative", "truth"))
    row = report["reconstruction"]["pillar"]["conservative"]
    assert row["alarms"]["mean"] == pytest.approx(1 - row["precision"]["mean"]) != 0
    assert row["by_class"]["occluded"]["alarms"]["n"]
    planned = report["planning"]["pillar"]["truth"]
    assert 0 < planned["evenness"]["mean"] <= 1
    assert {"evenness", "length"} < set(planned["successes"])
    assert [test["metric"] for test in report["tests"]["pillar"]].count("alarms") == 1
    show_tables(report)
    heads = {word for line in capsys.readouterr().out.splitlines() for word in line.split()}
    assert heads >= {"iou", "alarms", "success", "evenness"}
    paper_rows = [
        line for line in (tmp_path / "report.md").read_text().splitlines() if line.startswith("| *")
    ]
    assert len(paper_rows) == 6
    assert all(line.endswith("* | – |") for line in paper_rows)


def test_a_report_is_json_where_nothing_was_measured(dataset, tmp_path, monkeypatch):
    never = Metric(
        title="never", of=lambda s: float("nan"), needs="distance", better="lower", tested=("map",)
    )
    monkeypatch.setitem(METRICS, "never", never)
    report_of(dataset, tmp_path, names=("returns", "truth"))

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    held = json.loads((tmp_path / "report.json").read_text(), parse_constant=refuse)
    assert held["reconstruction"]["pillar"]["truth"]["never"] == dict.fromkeys(
        ("mean", "std", "low", "high")
    ) | {"n": 0}
    (test,) = (test for test in held["tests"]["pillar"] if test["metric"] == "never")
    assert (test["difference"], test["p"]) == (None, 1.0)
    assert "| returns − truth | never | – | 1.0000 |" in (tmp_path / "report.md").read_text()
