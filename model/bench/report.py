"""The report: both tables, with the paper's figures beside ours, as JSON for machines, and as
Markdown and one HTML page for people. The page has no script and fetches nothing; texts and names
are shown as text alone.

Its figures are the means of every metric, and methods compared in pairs.
"""

import base64
import math
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from scenegen.base.files import Json
from scenegen.model.bench.metrics import METRICS, PLAN_METRICS, Metric, ScoredMap
from scenegen.model.bench.reliability import reliability, reliability_tables
from scenegen.model.bench.run import DatasetResult, MethodResult
from scenegen.model.bench.statistics import (
    brief,
    caution,
    cell,
    holm,
    interval,
    paired_p,
    summarise,
    with_std,
)
from scenegen.model.bench.visibility import CLASSES
from scenegen.model.config import NEAR_M, UNITS
from scenegen.model.tables import Dot, Table, as_text, chart, framed, page


def summaries(
    method: MethodResult,
    result: DatasetResult,
    metrics: Mapping[str, Metric],
    region: int = 0,
    chosen: Any = True,
) -> Json:
    """Summarise metrics.

    Args:
        method: The method.
        result: All methods on the dataset.
        metrics: The metrics by name.
        region: Row of `MethodResult.reconstruction`, for metrics of maps.
        chosen: Mask of trials (trials,), for metrics of trials; True: all.

    Returns:
        Figures by metric, see `summarise`.
    """
    return {
        name: summarise(
            np.where(chosen, method.values(name, region), np.nan),
            result.worlds_of(name),
            metric.scale,
        )
        for name, metric in metrics.items()
    }


def reconstruction_of(method: MethodResult, result: DatasetResult) -> Json:
    """Summarise the metrics of maps.

    Args:
        method: The method.
        result: All methods on the dataset.

    Returns:
        Means over the whole map at the usual thresholds, by metric, and variants under keys of
        their own.
    """
    # metrics of whole maps have no value in a part of one
    in_parts = {name: metric for name, metric in result.metrics.items() if metric.needs != "map"}
    unobserved, *by_class = (
        summaries(method, result, in_parts, region) for region in range(1, len(CLASSES) + 2)
    )
    whole_map, tuned = (summaries(method, result, result.metrics, row) for row in (0, -1))
    # only of methods that draw; the truth chooses it, so it stands apart from all other figures
    best = {}
    if method.best is not None:
        over_best = replace(method, reconstruction=method.best[:, None])
        best = {BEST_DRAW: summaries(over_best, result, result.metrics)}
    return {
        **whole_map,
        **best,
        "tuned": {**tuned, "thresholds": asdict(method.thresholds)},
        "unobserved": unobserved,
        "by_class": dict(zip(CLASSES, by_class, strict=True)),
    }


def planning_of(method: MethodResult, result: DatasetResult) -> Json:
    """Summarise the metrics of trials.

    Args:
        method: The method.
        result: All methods on the dataset.

    Returns:
        Means over all trials, by metric, and over some of them under keys of their own;
        ``unmarked`` only for maps of real places.
    """
    on_paths = {name: metric for name, metric in PLAN_METRICS.items() if metric.needs == "path"}
    methods = result.methods.values()
    learned = [method for method in methods if method.learned] or methods
    succeeded = [trial.success for trial in method.trials]
    # (learned methods, trials). Lengths and clearances of two methods can be compared only on the
    # same trials: one that fails the hard ones would have the shorter paths
    all_succeeded = [[trial.success for trial in method.trials] for method in learned]
    causes = (trial.cause for trial in method.trials if trial.cause is not None)
    unmarked = {}
    if method.unmarked:
        unmarked = {"unmarked": summaries(method.without_marks, result, PLAN_METRICS)}
    return {
        **summaries(method, result, PLAN_METRICS),
        **unmarked,
        "successes": summaries(method, result, on_paths, chosen=succeeded),
        "all_succeed": summaries(method, result, on_paths, chosen=np.all(all_succeeded, axis=0)),
        "failures": dict(Counter(causes)),
    }


def paired_tests(result: DatasetResult, rng: np.random.Generator) -> list[Json]:
    """Compare every pair of methods by every tested metric.

    Args:
        result: All methods on a dataset.
        rng: Draws the permutations.

    Returns:
        A row for each pair and metric: the mean difference with its 95 % interval, and its p-value,
        also corrected over all rows.
    """
    tested = [
        (region, name)
        for region, metrics in (
            ("map", result.metrics),
            ("unobserved", result.metrics),
            ("map", PLAN_METRICS),
            ("unmarked", PLAN_METRICS),
        )
        for name, metric in metrics.items()
        if region in metric.tested and (region != "unmarked" or result.marks_unknown)
    ]
    # the same samples and goals for both, so differences are paired
    rows = []
    for (first, first_result), (second, second_result) in combinations(result.methods.items(), 2):
        for region, name in tested:
            if region == "unmarked":
                pair = first_result.without_marks, second_result.without_marks
            else:
                pair = first_result, second_result
            a, b = (method.values(name, int(region == "unobserved")) for method in pair)
            worlds = result.worlds_of(name)
            gained = summarise(a - b, worlds, "gain" if name in PLAN_METRICS else "amount")
            title = name if region == "map" else f"{region}_{name}"
            rows.append(
                {
                    "first": first,
                    "second": second,
                    "metric": title,
                    "difference": gained["mean"],
                    "low": gained["low"],
                    "high": gained["high"],
                    "p": paired_p(a, b, worlds, rng=rng),
                }
            )
    # some hundred tests: without a correction, a few would be significant by chance
    for row, corrected in zip(rows, holm([row["p"] for row in rows]).tolist(), strict=True):
        row["p_holm"] = corrected
    return rows


PAPER = tomllib.loads(Path(__file__).with_name("paper.toml").read_text(encoding="utf-8"))
"""The paper's Tables I and II, to stand beside ours: by table, kind of worlds, method and metric,
the mean, and the standard deviation where the paper gives one."""
TUNED = (
    "The presets of our worlds were tuned until planning on the true map and on the returns alone "
    "bracketed the paper's Table II or came near it (docs/results/findings.md), so agreement "
    "with that table is in part by construction."
)
"""Caution that stands beside the paper's figures, wherever they are printed."""
BEST_IOU = "best_iou"
"""A column of the tables."""
BEST_DRAW = "best_of_draws"
"""Key of the metrics of the best draw of each map, by the truth: no method knows which it is."""
ARROWS = {"higher": " ↑", "lower": " ↓", "nearer to 0": ""}
UNMARKED = "known space not marked"
"""Of a table."""
LEADS = {
    "planning": ("success", "Paths planned on the maps of {} succeed most often"),
    f"planning, {UNMARKED}": ("hits", "Paths planned on the maps of {} hit obstacles least often"),
    "reconstruction": ("iou", "The maps of {} have the highest IoU"),
}
"""By the table, the metric that the story is about, and how the story begins."""
CHARTS = ("success", "iou", "hits", "success_blocked", "near_rmse", "min_clearance")
"""Metrics that are drawn, of the tables that have them."""
MARKS = (
    "Dots are means. Lines, and brackets, are 95 % intervals, not corrected for the choice of the "
    "best. Grey: a reference, which reads the truth."
)
REFERENCES = ("truth", "seen", "moved", "flow")
"""Rows that read the ground truth, so that they are never marked as the best."""
CAUSES = {
    "start_blocked": "none: the start is occupied",
    "goal_blocked": "none: the goal is occupied",
    "no_path": "none leads to the goal",
    "initial_collides": "hits an obstacle",
    "refined_into_obstacle": "refined into an obstacle",
}
"""Results of a path in words, by the bench's causes of failure."""


def build_report(results: Sequence[DatasetResult], *, seed: int, about: Json) -> Json:
    """Collect all figures of a bench.

    A figure is ``{mean, std, low, high, n}`` at the paper's thresholds. With one world, low and
    high are None; where nothing was measured, mean and std are, too. JSON has no NaN and infinity,
    so these are None.

    Args:
        results: The results by kind of worlds.
        seed: Seed of the permutations of paired tests.
        about: Facts to add as they are.

    Returns:
        ``reconstruction[kind][method][metric]``, ``planning[kind][method][metric]``, `tests`,
        `datasets`, and the facts.
    """
    parts = ("reconstruction", "planning", "tests", "datasets")
    report = {**about, **{part: {} for part in parts}}
    for result in results:
        # anew for each kind, so that its p-values do not depend on the other datasets
        rng = np.random.default_rng(seed)
        first = next(iter(result.methods.values()))  # whose trials have the goals of all
        methods, cautions = result.methods.items(), list[str]()
        if result.known_share < 1:
            cautions.append(
                f"{100 * result.known_share:.1f} % of the grid is known in the mean: scores count "
                "known voxels alone, and a path that leaves known space fails. Planning is scored "
                "twice: with known space marked (all other voxels are occupied to the planner, "
                "which shows it where the place ends), and not marked"
            )
        if names := ", ".join(result.without_truth):
            cautions.append(
                f"the metrics of {names} are left out: the dataset lacks a part of samples that "
                "their truth needs"
            )
        report["datasets"][result.kind] = {
            "digest": result.dataset.digest,
            "samples": len(result.worlds),
            "worlds": len(np.unique(result.worlds)),
            "known_share": result.known_share,
            "thresholds": asdict(result.config.thresholds),
            "note": "; ".join(cautions),
            "trials": len(result.trial_worlds),
            "blocked_lines": sum(trial.line_blocked for trial in first.trials),
            "excluded": dict(result.excluded),
        }
        if any(method.best is not None for method in result.methods.values()):
            report["datasets"][result.kind]["draws"] = result.config.draws
        # a reader of the report has none of the code behind these
        if further := {
            name: {"title": metric.title, "better": metric.better, "unit": metric.unit}
            for name, metric in result.metrics.items()
            if name not in METRICS
        }:
            report["datasets"][result.kind]["metrics"] = further
        parts_of = {"reconstruction": reconstruction_of, "planning": planning_of}
        for part, figures_of in parts_of.items():
            report[part][result.kind] = {
                name: figures_of(method, result) for name, method in methods
            }
        report["tests"][result.kind] = paired_tests(result, rng)
        if result.config.reliability:
            report.setdefault("reliability", {})[result.kind] = {
                name: reliability(np.array(method.probabilities), result.worlds) or None
                for name, method in methods
            }
    return nan_as_none(report)


def notes(about: Json) -> list[str]:
    """Cautions about the figures of one of the report's `datasets`."""
    return [line for line in (about["note"], caution(about["worlds"])) if line]


def trial_counts(about: Json) -> str:
    """Describe the trials of one of the report's `datasets`: their number by kind."""
    blocked = about["blocked_lines"]
    return (
        f"{about['trials']} planning trials: on {blocked} an obstacle blocks the straight line to "
        f"the goal, on {about['trials'] - blocked} it is free"
    )


def nan_as_none(value: Any) -> Any:
    """Replace numbers that are NaN or infinite by None, in a tree of dicts and lists."""
    if isinstance(value, Mapping):
        return {name: nan_as_none(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [nan_as_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def tables(report: Json, kind: str) -> Iterator[tuple[str, Mapping[str, Metric], Json, Json]]:
    """List the tables of a kind of worlds.

    Beside IoU stands IoU at the row's best threshold. If that is not the bench's, the figure says
    which it is, as `at`.

    Args:
        report: From `build_report`.
        kind: The kind.

    Yields:
        Title, metrics by name, rows by method, and the paper's rows.
    """
    about, metrics = report["datasets"][kind], dict[str, Metric]()
    usual = about["thresholds"]
    entries = about.get("metrics", {}).items()
    # a user's own metrics are shown by the report's entries: their code need not be at hand
    further = {name: Metric(of=_unknown, **entry) for name, entry in entries}
    for name, metric in {**METRICS, **further}.items():
        metrics[name] = metric
        if name == "iou":
            metrics[BEST_IOU] = replace(metric, title="IoU at its best threshold")
    rows = {}
    for method, row in report["reconstruction"][kind].items():
        tuned = row["tuned"]["thresholds"]
        at = "".join(
            f"{tuned[name]:g}{unit}" for name, unit in UNITS.items() if tuned[name] != usual[name]
        )
        rows[method] = {**row, BEST_IOU: {**row["tuned"]["iou"], "at": at}}
    yield "reconstruction", metrics, rows, PAPER["reconstruction"].get(kind, {})
    if best := {method: row[BEST_DRAW] for method, row in rows.items() if BEST_DRAW in row}:
        title = f"reconstruction, each map's best of {about['draws']} draws by the truth"
        yield title, {**METRICS, **further}, best, {}
    planning, paper = report["planning"][kind], PAPER["planning"].get(kind, {})
    if not any("unmarked" in row for row in planning.values()):
        yield "planning", PLAN_METRICS, planning, paper
        return
    # in real places, success depends on the map's end; hits of known obstacles do not
    metrics = {"hits": PLAN_METRICS["hits"], **PLAN_METRICS}
    unmarked = {name: row["unmarked"] for name, row in planning.items()}
    yield f"planning, {UNMARKED}", metrics, unmarked, paper
    yield "planning, known space marked", metrics, planning, paper


def _unknown(scored_map: ScoredMap) -> float:
    """Stand for a metric of a user's own: a report holds its title, but not its code."""
    raise NotImplementedError


def blocks(report: Json, kind: str) -> Iterator[str | Table]:
    """List the sentences and tables about one kind of worlds.

    Args:
        report: From `build_report`.
        kind: The kind.

    Yields:
        A paragraph or a table.
    """
    about = report["datasets"][kind]
    yield story(report, kind)
    yield _introduction(about)
    if kind in PAPER["planning"]:
        yield f"In italics, and as rings: the paper's figures, of its own worlds. {TUNED}"
    yield from (f"{note}." for note in notes(about))
    at = about["thresholds"]
    note = (
        f"Occupied: a probability above {at['probability']:g} or, where a method gives none, a "
        f"distance below {at['distance_m']:g} m. Near: at most {NEAR_M:g} m from an obstacle."
    )
    for title, metrics, rows, paper in tables(report, kind):
        yield Table(
            title.capitalize(),
            [f"{metric.label}{ARROWS[metric.better]}" for metric in metrics.values()],
            [(method, [cell(row[name]) for name in metrics]) for method, row in rows.items()],
            [
                (method, [with_std(*row[name]) if name in row else "–" for name in metrics])
                for method, row in paper.items()
            ],
            [
                (method, column)
                for column, (name, metric) in enumerate(metrics.items())
                for method in best(rows, name, metric)
            ],
            note,
        )
    yield _failures(report["planning"][kind])
    reliabilities = report.get("reliability", {}).get(kind, {})
    yield from (Table(*table) for table in reliability_tables(reliabilities))
    by_class = [
        (method, [cell(row["by_class"][name]["iou"]) for name in CLASSES])
        for method, row in report["reconstruction"][kind].items()
    ]
    yield Table("IoU by what was seen", CLASSES, by_class, note=note)
    yield _paired_tests(report["tests"][kind])


def _introduction(about: Json) -> str:
    """A dataset's size, and how its tables are to be read."""
    excluded = ", ".join(f"{cause} {count}" for cause, count in about["excluded"].items())
    return (
        f"{about['samples']} samples of {about['worlds']} worlds, dataset "
        f"{str(about['digest'])[:12]}…; {trial_counts(about)}; excluded draws: "
        f"{excluded or 'none'}. Mean ± standard deviation over samples or trials, in brackets the "
        f"95 % interval of the mean, by a jackknife over worlds"
        f"{', which one world does not give' * (about['worlds'] == 1)}."
    )


def _failures(planning: Json) -> Table:
    """Tabulate failed trials of each method by cause. Causes without a trial are left out."""
    rows = {method: row["failures"] for method, row in planning.items()}
    causes = [cause for cause in CAUSES if any(cause in row for row in rows.values())]
    return Table(
        "Trials that failed, by what became of the path",
        [CAUSES[cause] for cause in causes],
        [(method, [str(row.get(cause, 0)) for cause in causes]) for method, row in rows.items()],
    )


def _paired_tests(tests: Sequence[Json]) -> Table:
    """Tabulate the results of `paired_tests`, a row each."""
    rows = []
    for test in tests:
        difference = "–"
        if test["difference"] is not None:
            difference = f"{test['difference']:+.3f} {interval(test, '+.3f')}"
        cells = (test["metric"], difference, f"{test['p_holm']:.4f}")
        rows.append((f"{test['first']} − {test['second']}", cells))
    return Table("Paired tests, by world, Holm-corrected", ("metric", "difference", "p"), rows)


def story(report: Json, kind: str) -> str:
    """Say in words which method is best, and whether its lead over the next is shown.

    Args:
        report: From `build_report`.
        kind: The kind of worlds.

    Returns:
        A sentence for each of `LEADS`. Both methods have the same samples and trials. A lead is not
        shown where its 95 % interval holds 0, or where there is none.
    """
    sentences = []
    for table, metrics, rows, _ in tables(report, kind):
        name, begin = LEADS.get(table, ("", ""))
        if name and (order := ranked(rows, name, metrics[name])):
            pair = [method for _, method in order[:2]]
            figures = f"{begin.format(pair[0])}: {brief(rows[pair[0]][name])}"
            tested = f"unmarked_{name}" if table.endswith(UNMARKED) else name
            for test in report["tests"][kind]:
                if test["metric"] == tested and {test["first"], test["second"]} == {*pair}:
                    figures += _lead(test, pair, metrics[name].better)
            alone = ", and no other method was measured" * (len(pair) < 2)
            sentences.append(f"{figures}{alone}.")
    return " ".join(sentences) or "Only references were measured."


def _lead(test: Json, pair: Sequence[str], better: str) -> str:
    """Write how far the first of a pair leads the next, or that a lead is not shown."""
    first, second = pair
    # a gain, whichever of both was subtracted
    sign = 1 if (test["first"] == first) == (better == "higher") else -1
    low, high = sorted(sign * (test[end] or 0) for end in ("low", "high"))
    gain = f"{sign * (test['difference'] or 0):.3f} [{low:.3f}, {high:.3f}]"
    if test["low"] is None:
        gain = "one world gives no interval"
    if low <= 0:
        return f". A lead over {second}, the next, is not shown: {gain}"
    return f", which is {gain} {better} than {second}, the next"


def ranked(rows: Json, name: str, metric: Metric) -> list[tuple[float, str]]:
    """Order methods by a metric's mean, as it is printed, without the references.

    Args:
        rows: Figures by method and metric.
        name: Name of the metric.
        metric: The metric.

    Returns:
        How far each is from the best possible, and its name; the best first.
    """
    worth = {"higher": lambda mean: -mean, "lower": lambda mean: mean, "nearer to 0": abs}
    # as printed: a difference that no reader sees marks nobody as the best
    return sorted(
        (worth[metric.better](round(row[name]["mean"], 3)), method)
        for method, row in rows.items()
        if row[name]["n"] and method not in REFERENCES
    )


def best(rows: Json, name: str, metric: Metric) -> set[str]:
    """Find the methods with the best mean, see `ranked`.

    Args:
        rows: Metrics by method.
        name: Name of the metric.
        metric: The metric.

    Returns:
        Names; several, if their printed means are equal.
    """
    order = ranked(rows, name, metric)
    return {method for worth, method in order if worth == order[0][0]}


def charts(report: Json, kind: str) -> str:
    """Draw means and their intervals: the story's first.

    Args:
        report: From `build_report`.
        kind: The kind of worlds.

    Returns:
        SVG charts, as HTML.
    """
    drawn = ""
    for name, (table, metrics, rows, paper) in product(CHARTS, tables(report, kind)):
        dots = [
            Dot(
                method,
                row[name]["mean"],
                row[name]["low"],
                row[name]["high"],
                "reference" * (method in REFERENCES),
            )
            for method, row in rows.items()
            if name in metrics and row[name]["n"]
        ]
        if dots:
            dots += [
                Dot(f"{method} (paper)", row[name][0], style="paper")
                for method, row in paper.items()
                if name in row
            ]
            _, comma, where = table.partition(", ")
            drawn += chart(metrics[name].label + ARROWS[metrics[name].better] + comma + where, dots)
    return drawn


def to_markdown(report: Json) -> str:
    """Write the report as Markdown."""
    about = [f"- {name}: {value}" for name, value in report.items() if isinstance(value, str)]
    parts = ["# Bench", "\n".join(about)]
    for kind in report["datasets"]:
        parts.append(f"## {kind}")
        parts += [
            block if isinstance(block, str) else block.markdown() for block in blocks(report, kind)
        ]
    return "\n\n".join(parts) + "\n"


def to_html(
    report: Json, pictures: Mapping[str, Sequence[tuple[str, bytes]]], samples: str = ""
) -> str:
    """Write the report as an HTML page.

    Args:
        report: From `build_report`.
        pictures: Failures by kind: a caption and a WebP image each.
        samples: Name of a page of samples beside this one, which it shows in a frame; "": none.

    Returns:
        The page, pictures included: it fetches nothing but the page of samples.
    """
    body = []
    for kind in report["datasets"]:
        told, *further = (
            f"<p>{as_text(block)}</p>" if isinstance(block, str) else block.html()
            for block in blocks(report, kind)
        )
        images = "".join(
            f"<figure><figcaption>{as_text(caption)}</figcaption><img alt='{as_text(caption)}' "
            f"src='data:image/webp;base64,{base64.b64encode(image).decode()}'></figure>"
            for caption, image in pictures.get(kind, ())
        )
        body += [
            f"<h2>{as_text(kind)}</h2><div class='story'>{told}</div>",
            f"<div class='charts'>{charts(report, kind)}</div>",
            f"<p>{MARKS}</p>",
            *further,
            f"<div class='charts'>{images}</div>",
        ]
    if samples:
        body.append(framed("Worst and median maps of the method with the highest IoU", samples))
    about = "".join(
        f"<dt>{as_text(name)}</dt><dd>{as_text(value)}</dd>"
        for name, value in report.items()
        if isinstance(value, str)
    )
    return page("Bench", f"{''.join(body)}<h2>About</h2><dl>{about}</dl>")
