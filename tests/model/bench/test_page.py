"""The report as a page: its story, charts and tables, which is best, and that it runs nothing."""

import dataclasses
import html
import json

import numpy as np
import pytest

from scenegen import Dataset
from scenegen.model.bench.methods import Completed, Truth
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS
from scenegen.model.bench.report import (
    PAPER,
    TUNED,
    best,
    build_report,
    story,
    to_html,
    to_markdown,
)
from scenegen.model.bench.run import bench
from scenegen.model.bench.shown import draw_failures, extremes, failing
from scenegen.model.completion.protocol import ReturnsCompleter
from scenegen.model.config import BenchConfig, Thresholds
from tests.model.bench.test_bench import Nothing
from tests.scenegen import each_case
from tests.scenegen.view.test_page import Seen

HOSTILE = "</td><script>alert(1)</script><img src=x onerror=alert(2)>&amp;"


@pytest.fixture(scope="module")
def measured(made):
    blind = Nothing()  # is taken for a learned one, and its paths go through everything
    blind.name = HOSTILE
    methods = [Truth(), Completed(ReturnsCompleter()), Completed(blind)]
    config = BenchConfig(split="train", trials=40, thresholds=Thresholds(probability=0.4))
    return bench(Dataset(made), methods, config), methods


def report_with(result, **changes):
    """The report of a result that is changed."""
    return build_report([dataclasses.replace(result, **changes)], seed=0, about={})


@pytest.fixture
def report(measured):
    """The report of what was measured."""
    return report_with(measured[0])


def test_the_page_holds_figures_and_runs_nothing(measured, monkeypatch):
    """Both tables, the paper's, charts and pictures."""
    monkeypatch.setattr("scenegen.view.stills.DPI", 40)
    result, methods = measured
    name, trials = failing(result)
    assert name == HOSTILE
    assert 0 < len({result.trial_worlds[n] for n in trials}) == len(trials) <= 3
    report = build_report([result], seed=0, about={"command": HOSTILE})
    failures = draw_failures(result, methods)
    page = Seen(to_html(report, {result.kind: failures}))
    tags, attributes, texts = zip(*page.found, strict=True)
    assert not {*tags} & {"script", "iframe", "object", "embed", "link", "a"}
    names = {name for names in attributes for name in names}
    assert not {name for name in names if name.startswith("on") or name == "href"}
    images = [names["src"] for names in attributes if "src" in names]
    assert len(images) == len(failures) == len(trials)
    assert {str(source)[:27] for source in images} == {"data:image/webp;base64,UklG"}  # RIFF
    text = " ".join(texts)
    assert text.count("above 0.4 or") == 3  # captions of both tables, and by class
    assert text.count(HOSTILE) >= 4  # the command, a row of each table, failures
    for table, metrics in (("reconstruction", METRICS), ("planning", PLAN_METRICS)):
        rows = report[table][result.kind].values()
        means = [row[name]["mean"] for row in rows for name in metrics if row[name]["n"]]
        papers = [mean for row in PAPER[table][result.kind].values() for mean, *_ in row.values()]
        assert [mean for mean in means + papers if f"{mean:.3f}" not in text] == []


def test_a_chart_has_a_dot_each_method(report):
    _, *charts = to_html(report, {}).split("<svg")
    dots = [chart.partition("</svg>")[0].count("<circle") for chart in charts]
    papers = len(PAPER["planning"]["pillar"])
    assert dots[:2] == [3 + papers, 3 + papers]  # success and IoU lead


def test_the_page_of_samples_shows_the_worst(measured, report):
    result, methods = measured
    samples = Seen(extremes(report, [result], methods)).data()["samples"]
    worst = result.numbers[int(np.argmin(result.methods["returns"].values("iou")))]
    assert [len(sample["guesses"]) for sample in samples] == [1, 1]
    assert samples[0]["name"] == f"pillar, worst of returns: train {worst}"
    beside = Seen(to_html(report, {}, "samples.html"))
    fetched = [names["src"] for tag, names, _ in beside.found if "src" in names]
    assert fetched == ["samples.html"]


def test_one_world_gives_no_interval(measured):
    result = measured[0]
    worlds = {name: np.zeros_like(getattr(result, name)) for name in ("worlds", "trial_worlds")}
    report = report_with(result, **worlds)
    figure = report["reconstruction"]["pillar"]["returns"]["iou"]
    assert (figure["low"], figure["high"], figure["n"]) == (None, None, 11)
    assert {test["low"] for test in report["tests"]["pillar"]} == {None}
    assert "nan" not in to_markdown(report)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["truth"], "Only references were measured."),
        (["truth", "returns"], ", and no other method was measured."),
    ],
)
def test_a_story_needs_a_method(measured, names, expected):
    methods = {name: measured[0].methods[name] for name in names}
    assert story(report_with(measured[0], methods=methods), "pillar").endswith(expected)


LEADS = [
    ((0.02, 0.06), ", which is 0.040 [0.020, 0.060] higher than b, the next."),
    ((-0.01, 0.09), ". A lead over b, the next, is not shown: 0.040 [-0.010, 0.090]."),
    ((None, None), ". A lead over b, the next, is not shown: one world gives no interval."),
]


@pytest.mark.parametrize(("ends", "expected"), LEADS)
@pytest.mark.parametrize("turned", [False, True])
def test_a_lead_may_not_be_shown(report, ends, expected, turned):
    """Whichever of both methods was subtracted."""
    figures = {"std": 0.1, "low": 0.1, "high": 0.9, "n": 9}
    row = report["planning"]["pillar"]["truth"]
    report["planning"]["pillar"] = {
        name: {**row, "success": {**figures, "mean": mean}}
        for name, mean in (("b", 0.5), ("a", 0.54), ("truth", 1.0))
    }
    names, difference, (low, high) = ("a", "b"), 0.04, ends
    if turned:
        names, difference = ("b", "a"), -0.04
        low, high = (None, None) if low is None else (-high, -low)
    test = {"first": names[0], "second": names[1], "metric": "success"}
    test |= {"difference": difference, "low": low, "high": high}
    report["tests"]["pillar"].append(test)
    begin = "Paths planned on the maps of a succeed most often: 0.540 [0.100, 0.900]"
    assert begin + expected in story(report, "pillar")


def test_the_papers_figures_say_how_presets_were_tuned(report):
    """Whatever prints them; a kind that the paper does not have says nothing of it."""
    other = {part: {"rooms": by_kind["pillar"]} for part, by_kind in report.items()}
    for write in (to_markdown, lambda report: html.unescape(to_html(report, {}))):
        assert write(report).count(TUNED) == 1
        assert "paper" not in write(other).rpartition("</style>")[2]


@each_case("../model/best", "better means expected", json.loads)
def test_the_best_is_the_best_as_printed(better, means, expected):
    """And never the truth."""
    rows = {name: {"x": {"mean": mean, "n": mean is not None}} for name, mean in means.items()}
    found = best(rows, "x", dataclasses.replace(METRICS["iou"], better=better))
    assert sorted(found) == expected
