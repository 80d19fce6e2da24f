"""The report: both tables, with the paper's figures beside ours, as JSON for machines and Markdown
for people."""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from scenegen.model.config import Thresholds
from scenegen.model.evaluation import paper
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS, Metric
from scenegen.model.evaluation.run import DatasetResult, MethodResult
from scenegen.model.evaluation.statistics import (
    Scale,
    caution,
    cell,
    figure,
    head,
    holm,
    interval,
    line,
    paired_p,
    spread,
)
from scenegen.model.evaluation.study import study_lines, study_of
from scenegen.model.evaluation.visibility import CLASSES

BEST_IOU, UNITS = "best_iou", {"probability": "", "distance_m": " m"}
"""A column of the tables, and the units of the thresholds at which it stands."""
REGIONS = ("map", "unobserved")
"""Rows of a sample's reconstruction before those of the classes of voxels."""


def build_report(
    results: Sequence[DatasetResult], *, seed: int, about: Mapping[str, Any], tests: bool = True
) -> dict[str, Any]:
    """All figures: ``reconstruction[kind][method][metric]`` and ``planning[kind][method][metric]``,
    each {mean, std, low, high, n}, at the paper's thresholds; variants under their own keys beside
    them; `about` as it is. Where there is one world, low and high are None; where nothing was
    measured, mean and std are, too. No number is NaN or infinite, which JSON has no words for:
    those are None. Every two methods are compared where `tests` asks for it."""
    report: dict[str, Any] = {
        **about,
        "reconstruction": {},
        "planning": {},
        "tests": {},
        "datasets": {},
    }
    for result in results:
        rng = np.random.default_rng(seed)
        methods = result.methods.items()
        report["datasets"][result.kind] = {
            "digest": result.digest,
            "samples": len(result.worlds),
            "worlds": len(np.unique(result.worlds)),
            "trials": len(result.trial_worlds),
            "excluded": dict(result.excluded),
        }
        report["reconstruction"][result.kind] = {
            name: _reconstruction(found, result) for name, found in methods
        }
        report["planning"][result.kind] = {
            name: _planning(found, result) for name, found in methods
        }
        report["tests"][result.kind] = _tests(result, rng) if tests else []
        if result.config.study:
            report.setdefault("study", {})[result.kind] = {
                name: study_of(found.studies, found.careful, result.worlds, result.trial_worlds)
                for name, found in methods
            }
    return finite(report)


def finite(value: Any) -> Any:
    """`value`, a tree of dicts and lists, with None for every number that is NaN or infinite."""
    if isinstance(value, Mapping):
        return {name: finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _reconstruction(found: MethodResult, result: DatasetResult) -> dict[str, Any]:
    def figures(values: np.ndarray) -> dict[str, Any]:
        return {
            name: figure(values[:, m], result.worlds, metric.scale)
            for m, (name, metric) in enumerate(METRICS.items())
        }

    return {
        **figures(found.reconstruction[:, 0]),
        "tuned": {**figures(found.tuned), "thresholds": dataclasses.asdict(found.thresholds)},
        "unobserved": figures(found.reconstruction[:, 1]),
        "by_class": {
            name: figures(found.reconstruction[:, 2 + c]) for c, name in enumerate(CLASSES)
        },
    }


def _planning(found: MethodResult, result: DatasetResult) -> dict[str, Any]:
    on_paths = {name: one for name, one in PLAN_METRICS.items() if one.needs == "path"}

    def figures(metrics: Mapping[str, Metric], chosen: Any) -> dict[str, Any]:
        return {
            name: figure(
                np.where(chosen, _of_trials(metric, found), np.nan),
                result.trial_worlds,
                metric.scale,
            )
            for name, metric in metrics.items()
        }

    rows = result.methods.values()
    learned = [other for other in rows if other.learned] or rows
    succeeded = [[trial.success for trial in other.trials] for other in (found, *learned)]
    return {
        **figures(PLAN_METRICS, True),
        "successes": figures(on_paths, succeeded[0]),
        "all_succeed": figures(on_paths, np.all(succeeded[1:], axis=0)),
        "failures": dict(Counter(trial.cause for trial in found.trials if trial.cause is not None)),
    }


def _of_trials(metric: Metric, found: MethodResult) -> np.ndarray:
    """A planning metric of every trial, (trials,)."""
    return np.array([metric.of(trial) for trial in found.trials], dtype=np.float64)


def _tests(result: DatasetResult, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Every pair of methods on every tested metric: the mean difference with its 95 % interval, and
    its p-value, corrected over all of them."""
    rows: list[tuple[str, str, str, Scale, np.ndarray, np.ndarray, np.ndarray]] = []
    for (first, one), (second, other) in combinations(result.methods.items(), 2):
        for row, region in enumerate(REGIONS):
            for m, (name, metric) in enumerate(METRICS.items()):
                if region in metric.tested:
                    a, b = one.reconstruction[:, row, m], other.reconstruction[:, row, m]
                    title = name if region == "map" else f"{region}_{name}"
                    rows.append((first, second, title, "amount", a, b, result.worlds))
        for name, metric in PLAN_METRICS.items():
            if metric.tested:
                a, b = _of_trials(metric, one), _of_trials(metric, other)
                rows.append((first, second, name, "gain", a, b, result.trial_worlds))
    paired = [figure(a - b, worlds, scale) for *_, scale, a, b, worlds in rows]
    raw = [paired_p(a, b, worlds, rng=rng) for *_, a, b, worlds in rows]
    return [
        {"first": first, "second": second, "metric": metric}
        | {"difference": found["mean"], "low": found["low"], "high": found["high"]}
        | {"p": p, "p_holm": float(corrected)}
        for (first, second, metric, *_), found, p, corrected in zip(
            rows, paired, raw, holm(raw), strict=True
        )
    ]


def tables(
    report: Mapping[str, Any], kind: str
) -> Iterator[tuple[str, Mapping[str, Metric], Mapping[str, Any], Mapping[str, Any]]]:
    """Both tables of a kind: their name in the report, metrics, rows, and the paper's rows.

    Beside IoU stands IoU at the row's best threshold. Where that is not the paper's, the figure
    says where it lies: `at`.
    """
    metrics, usual = dict[str, Metric](), dataclasses.asdict(Thresholds())
    for name, metric in METRICS.items():
        metrics[name] = metric
        if name == "iou":
            metrics[BEST_IOU] = dataclasses.replace(
                metric, title="IoU at its best threshold", paper=False
            )
    rows = {}
    for method, row in report["reconstruction"][kind].items():
        tuned = row["tuned"]
        places = ((tuned["thresholds"][name], unit, usual[name]) for name, unit in UNITS.items())
        at = "".join(f"{value:g}{unit}" for value, unit, papers in places if value != papers)
        rows[method] = {**row, BEST_IOU: {**tuned["iou"], "at": at}}
    yield "reconstruction", metrics, rows, paper.RECONSTRUCTION.get(kind, {})
    yield "planning", PLAN_METRICS, report["planning"][kind], paper.PLANNING.get(kind, {})


def to_markdown(report: Mapping[str, Any]) -> str:
    """The report for people: Table I and Table II per kind, then failures, classes and tests."""
    lines = ["# Bench", ""]
    lines += [f"- {name}: {value}" for name, value in report.items() if isinstance(value, str)]
    for kind, about in report["datasets"].items():
        lines += [
            "",
            f"## {kind}",
            "",
            f"{about['samples']} samples of {about['worlds']} worlds, dataset "
            f"{about['digest'][:12]}…; "
            f"{about['trials']} planning trials, excluded draws: {about['excluded'] or 'none'}. "
            f"Mean ± standard "
            "deviation over samples or trials, in brackets the 95 % interval of the mean, by a "
            "jackknife over worlds"
            f"{', which one world does not give' * (about['worlds'] == 1)}. *Italics*: the "
            f"paper's.",
        ]
        lines += ["", f"**{few}.**"] if (few := caution(about["worlds"])) else []
        for title, metrics, table, reference in tables(report, kind):
            lines += ["", f"### {title.capitalize()}", "", *head(metrics)]
            lines += [line(name, (cell(row[m]) for m in metrics)) for name, row in table.items()]
            for name, row in reference.items():
                cells = (
                    f"*{spread(*row[m])}*" if metric.paper else "–" for m, metric in metrics.items()
                )
                lines.append(line(f"*{name}*", cells))
        lines += ["", "### Failures", ""]
        for name, row in report["planning"][kind].items():
            counted = ", ".join(
                f"{cause} {count}" for cause, count in sorted(row["failures"].items())
            )
            lines.append(f"- {name}: {counted or 'none'}")
        lines += study_lines(report.get("study", {}).get(kind, {}))
        lines += ["", "### IoU by what was seen", "", *head(CLASSES)]
        for name, row in report["reconstruction"][kind].items():
            lines.append(line(name, (cell(row["by_class"][c]["iou"]) for c in CLASSES)))
        lines += [
            "",
            "### Paired tests, by world, Holm-corrected",
            "",
            *head(("metric", "difference", "p")),
        ]
        for test in report["tests"][kind]:
            pair, found = f"{test['first']} − {test['second']}", "–"
            if test["difference"] is not None:
                found = f"{test['difference']:+.3f} {interval(test, '+.3f')}"
            lines.append(line(pair, (test["metric"], found, f"{test['p_holm']:.4f}")))
    return "\n".join(lines) + "\n"
