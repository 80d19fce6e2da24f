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


def test_the_page_holds_both_tables_the_paper_s_and_pictures_and_runs_nothing(
    measured, monkeypatch
):
    monkeypatch.setattr("scenegen.view.panels.DPI", 40)
    result, _, methods = measured
    name, trials = failing(result)
    assert name == HOSTILE
    assert 0 < len({result.trial_worlds[n] for n in trials}) == len(trials) <= 3
    pictures = draw_failures(result, methods)
    assert len(pictures) == len(trials)
    report = build_report([result], seed=0, about={"command": HOSTILE})
    charts = draw_charts(report, result.kind)
    pictures += charts
    assert all(image.startswith(b"RIFF") for _, image in pictures)
    seen = Seen(to_html(report, {result.kind: pictures}))
    running = {"script", "iframe", "object", "embed", "link", "a"}
    assert not {tag for tag, *_ in seen.found} & running
    assert not any(
        name.startswith("on") or name == "href" for _, names, _ in seen.found for name in names
    )
    images = [names["src"] for tag, names, _ in seen.found if tag == "img"]
    assert len(images) == len(pictures)
    assert all(str(source).startswith("data:image/webp;base64,") for source in images)
    said = " ".join(text for *_, text in seen.found)
    assert said.count(HOSTILE) >= 4  # the command, a row of each table, failures
    for table, metrics in (("reconstruction", METRICS), ("planning", PLAN_METRICS)):
        for row in report[table][result.kind].values():
            for metric in metrics:
                if row[metric]["n"]:
                    assert f"{row[metric]['mean']:.3f}" in said
    for row in (row for part in PAPER.values() for row in part[result.kind].values()):
        assert all(f"{mean:.3f}" in said for mean, *_ in row.values())


def test_the_papers_figures_stand_beside_how_presets_were_tuned(measured):
    """Whatever prints them; a kind that the paper does not have says nothing of it."""
    report = build_report([measured[0]], seed=0, about={})
    assert to_markdown(report).count(TUNED) == 1
    assert html.unescape(to_html(report, {})).count(TUNED) == 1
    parts = ("reconstruction", "planning", "tests", "datasets")
    other = {part: {"rooms": figures} for part in parts for figures in report[part].values()}
    _, body = to_html(other, {}).split("</style>")
    assert "paper" not in to_markdown(other) + body


def test_the_best_is_the_best_as_printed_and_never_the_truth():
    def rows(**means):
        return {
            name: {"x": {"mean": mean, "n": 0 if mean is None else 1}}
            for name, mean in means.items()
        }

    higher, lower, near = (
        dataclasses.replace(METRICS["iou"], better=better)
        for better in ("higher", "lower", "nearer to 0")
    )
    assert best(rows(truth=1.0, a=0.5001, b=0.5004, c=0.4), "x", higher) == {"a", "b"}
    assert best(rows(truth=0.0, a=0.3, b=0.2, c=None), "x", lower) == {"b"}
    assert best(rows(a=-0.02, b=0.03), "x", near) == {"a"}
    assert best(rows(truth=1.0), "x", higher) == set()
