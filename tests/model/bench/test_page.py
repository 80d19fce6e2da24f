"""The report as a page: what it says, which is best, and that nothing of it is a script."""

import dataclasses
import html

import pytest

from scenegen.dataset.read import Dataset
from scenegen.model.bench.methods import Completed, Truth
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS
from scenegen.model.bench.report import PAPER, TUNED, best, build_report, to_html, to_markdown
from scenegen.model.bench.run import bench
from scenegen.model.bench.shown import draw_charts, draw_failures, failing
from scenegen.model.completion.protocol import Returns
from scenegen.model.config import BenchConfig
from tests.model.bench.test_bench import Nothing
from tests.scenegen.view.test_page import Seen

HOSTILE = "</td><script>alert(1)</script><img src=x onerror=alert(2)>&amp;"


@pytest.fixture(scope="module")
def measured(made):
    blind = Nothing()  # is taken for a learned one, and its paths go through everything
    blind.name = HOSTILE
    methods = [Truth(), Completed(Returns()), Completed(blind)]
    dataset = Dataset(made)
    return bench(dataset, methods, BenchConfig(split="train", trials=40)), dataset, methods


def test_the_page_holds_figures_and_runs_nothing(measured, monkeypatch):
    """Both tables, the paper's, and pictures."""
    monkeypatch.setattr("scenegen.view.stills.DPI", 40)
    result, _, methods = measured
    name, trials = failing(result)
    assert name == HOSTILE
    assert 0 < len({result.trial_worlds[n] for n in trials}) == len(trials) <= 3
    report = build_report([result], seed=0, about={"command": HOSTILE})
    failures = draw_failures(result, methods)
    assert len(failures) == len(trials)
    pictures = failures + draw_charts(report, result.kind)
    assert all(image.startswith(b"RIFF") for _, image in pictures)
    page = Seen(to_html(report, {result.kind: pictures}))
    running = {"script", "iframe", "object", "embed", "link", "a"}
    assert not {tag for tag, *_ in page.found} & running
    attributes = {name for _, names, _ in page.found for name in names}
    assert not {name for name in attributes if name.startswith("on") or name == "href"}
    images = [names["src"] for tag, names, _ in page.found if tag == "img"]
    assert len(images) == len(pictures)
    assert all(str(source).startswith("data:image/webp;base64,") for source in images)
    text = " ".join(text for *_, text in page.found)
    assert text.count(HOSTILE) >= 4  # the command, a row of each table, failures
    for table, metrics in (("reconstruction", METRICS), ("planning", PLAN_METRICS)):
        rows = report[table][result.kind].values()
        means = [row[name]["mean"] for row in rows for name in metrics if row[name]["n"]]
        papers = [mean for row in PAPER[table][result.kind].values() for mean, *_ in row.values()]
        assert [mean for mean in means + papers if f"{mean:.3f}" not in text] == []


def test_the_papers_figures_say_how_presets_were_tuned(measured):
    """Whatever prints them; a kind that the paper does not have says nothing of it."""
    report = build_report([measured[0]], seed=0, about={})
    assert to_markdown(report).count(TUNED) == 1
    assert html.unescape(to_html(report, {})).count(TUNED) == 1
    parts = ("reconstruction", "planning", "tests", "datasets")
    other = {part: {"rooms": figures} for part in parts for figures in report[part].values()}
    _, body = to_html(other, {}).split("</style>")
    assert "paper" not in to_markdown(other) + body


@pytest.mark.parametrize(
    ("better", "means", "expected"),
    [
        ("higher", {"truth": 1.0, "a": 0.5001, "b": 0.5004, "c": 0.4}, {"a", "b"}),
        ("lower", {"truth": 0.0, "a": 0.3, "b": 0.2, "c": None}, {"b"}),
        ("nearer to 0", {"a": -0.02, "b": 0.03}, {"a"}),
        ("higher", {"truth": 1.0}, set()),
    ],
)
def test_the_best_is_the_best_as_printed(better, means, expected):
    """And never the truth."""
    rows = {name: {"x": {"mean": mean, "n": mean is not None}} for name, mean in means.items()}
    assert best(rows, "x", dataclasses.replace(METRICS["iou"], better=better)) == expected
