"""The report as a page: its story, charts and tables, which is best, and that it runs nothing."""

import dataclasses
import html
import json

import numpy as np
import pytest

from scenegen.dataset.read import Dataset
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
from scenegen.model.completion.protocol import Returns
from scenegen.model.config import BenchConfig, Thresholds
from tests.model.bench.test_bench import Nothing
from tests.scenegen import each_case
from tests.scenegen.view.test_page import Seen

HOSTILE = "</td><script>alert(1)</script><img src=x onerror=alert(2)>&amp;"


@pytest.fixture(scope="module")
def measured(made):
    blind = Nothing()  # is taken for a learned one, and its paths go through everything
    blind.name = HOSTILE
    methods = [Truth(), Completed(Returns()), Completed(blind)]
    dataset = Dataset(made)
    return bench(dataset, methods, BenchConfig(split="train", trials=40)), dataset, methods


@pytest.fixture
def report(measured):
    """The report of what was measured."""
    return build_report([measured[0]], seed=0, about={})


def test_the_page_holds_figures_and_runs_nothing(measured, monkeypatch):
    """Both tables, the paper's, charts and pictures."""
    monkeypatch.setattr("scenegen.view.stills.DPI", 40)
    result, _, methods = measured
    name, trials = failing(result)
    assert name == HOSTILE
    assert 0 < len({result.trial_worlds[n] for n in trials}) == len(trials) <= 3
    report = build_report([result], seed=0, about={"command": HOSTILE})
    failures = draw_failures(result, methods)
    assert len(failures) == len(trials)
    assert all(image.startswith(b"RIFF") for _, image in failures)
    page = Seen(to_html(report, {result.kind: failures}))
    running = {"script", "iframe", "object", "embed", "link", "a"}
    assert not {tag for tag, *_ in page.found} & running
    attributes = {name for _, names, _ in page.found for name in names}
    assert not {name for name in attributes if name.startswith("on") or name == "href"}
    images = [names["src"] for tag, names, _ in page.found if tag == "img"]
    assert len(images) == len(failures)
    assert all(str(source).startswith("data:image/webp;base64,") for source in images)
    text = " ".join(text for *_, text in page.found)
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


def test_captions_have_the_benchs_thresholds(measured):
    result = measured[0]
    other = dataclasses.replace(result.config, thresholds=Thresholds(probability=0.4))
    report = build_report([dataclasses.replace(result, config=other)], seed=0, about={})
    captions = [text for tag, _, text in Seen(to_html(report, {})).found if tag == "span"]
    assert sum("above 0.4 or" in text for text in captions) == 3  # both tables, and by class


def test_the_page_of_samples_shows_the_worst(measured, report):
    result, _, methods = measured
    samples = Seen(extremes(report, [result], methods)).data()["samples"]
    worst = result.numbers[int(np.argmin(result.methods["returns"].values("iou")))]
    assert [len(sample["guesses"]) for sample in samples] == [1, 1]
    assert samples[0]["name"] == f"pillar, worst of returns: train {worst}"
    beside = Seen(to_html(report, {}, "samples.html"))
    fetched = [names["src"] for tag, names, _ in beside.found if "src" in names]
    assert fetched == ["samples.html"]


LEADS = [
    ((0.02, 0.06), ", which is 0.040 [0.020, 0.060] higher than b, the next."),
    ((-0.01, 0.09), ". A lead over b, the next, is not shown: 0.040 [-0.010, 0.090]."),
    ((None, None), ". A lead over b, the next, is not shown: one world gives no interval."),
]


def test_a_story_needs_a_method(measured):
    result = measured[0]
    for names, expected in (
        (["truth"], "Only references were measured."),
        (["truth", "returns"], ", and no other method was measured."),
    ):
        methods = {name: result.methods[name] for name in names}
        report = build_report([dataclasses.replace(result, methods=methods)], seed=0, about={})
        assert story(report, "pillar").endswith(expected)


@pytest.mark.parametrize(("ends", "expected"), LEADS)
@pytest.mark.parametrize("turned", [False, True])
def test_a_lead_may_not_be_shown(report, ends, expected, turned):
    """Whichever of both methods was subtracted."""
    figures = {"std": 0.1, "low": 0.1, "high": 0.9, "n": 9}
    rows = report["planning"]["pillar"]
    means = {"b": 0.5, "a": 0.54, "truth": 1.0}
    report["planning"]["pillar"] = {
        name: {**rows["truth"], "success": {**figures, "mean": mean}}
        for name, mean in means.items()
    }
    low, high = ends if not turned or None in ends else (-ends[1], -ends[0])
    names = ("b", "a") if turned else ("a", "b")
    test = dict(zip(("first", "second"), names, strict=True), metric="success")
    test |= {"difference": -0.04 if turned else 0.04, "low": low, "high": high}
    report["tests"]["pillar"].append(test)
    begin = "Paths planned on the maps of a succeed most often: 0.540 [0.100, 0.900]"
    assert begin + expected in story(report, "pillar")


def test_the_papers_figures_say_how_presets_were_tuned(report):
    """Whatever prints them; a kind that the paper does not have says nothing of it."""
    assert to_markdown(report).count(TUNED) == 1
    assert html.unescape(to_html(report, {})).count(TUNED) == 1
    parts = ("reconstruction", "planning", "tests", "datasets")
    other = {part: {"rooms": figures} for part in parts for figures in report[part].values()}
    _, body = to_html(other, {}).split("</style>")
    assert "paper" not in to_markdown(other) + body


@each_case("../model/best", "better means expected", json.loads)
def test_the_best_is_the_best_as_printed(better, means, expected):
    """And never the truth."""
    rows = {name: {"x": {"mean": mean, "n": mean is not None}} for name, mean in means.items()}
    found = best(rows, "x", dataclasses.replace(METRICS["iou"], better=better))
    assert sorted(found) == expected
