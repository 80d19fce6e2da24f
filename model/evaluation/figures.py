"""Figures of a report: the means of every metric, and methods compared in pairs."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from itertools import combinations
from typing import Any

import numpy as np

from scenegen.files import Json
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS, Metric
from scenegen.model.evaluation.run import DatasetResult, MethodResult
from scenegen.model.evaluation.statistics import holm, paired_p, summarise
from scenegen.model.evaluation.visibility import CLASSES


def summaries(
    method: MethodResult,
    result: DatasetResult,
    metrics: Mapping[str, Metric],
    region: int = 0,
    chosen: Any = True,
) -> Json:
    """`summarise` of what `MethodResult.values` gives for each metric, of the `chosen` trials
    alone."""
    return {
        name: summarise(
            np.where(chosen, method.values(name, region), np.nan),
            result.worlds_of(name),
            metric.scale,
        )
        for name, metric in metrics.items()
    }


def reconstruction_of(method: MethodResult, result: DatasetResult) -> Json:
    """The metrics of maps: means over the whole map at the usual thresholds, and variants."""
    whole_map, unobserved, *by_class, tuned = (
        summaries(method, result, METRICS, region) for region in range(len(CLASSES) + 3)
    )
    return {
        **whole_map,
        "tuned": {**tuned, "thresholds": asdict(method.thresholds)},
        "unobserved": unobserved,
        "by_class": dict(zip(CLASSES, by_class, strict=True)),
    }


def planning_of(found: MethodResult, result: DatasetResult) -> Json:
    """The metrics of trials: means over all, and over some; ``unmarked`` only in maps of real
    places."""
    on_paths = {name: metric for name, metric in PLAN_METRICS.items() if metric.needs == "path"}
    methods = result.methods.values()
    learned = [method for method in methods if method.learned] or methods
    succeeded = [trial.success for trial in found.trials]
    # (learned methods, trials)
    all_succeeded = [[trial.success for trial in method.trials] for method in learned]
    causes = (trial.cause for trial in found.trials if trial.cause is not None)
    unmarked = {}
    if found.unmarked:
        unmarked = {"unmarked": summaries(found.without_marks, result, PLAN_METRICS)}
    return {
        **summaries(found, result, PLAN_METRICS),
        **unmarked,
        "successes": summaries(found, result, on_paths, chosen=succeeded),
        "all_succeed": summaries(found, result, on_paths, chosen=np.all(all_succeeded, axis=0)),
        "failures": dict(Counter(causes)),
    }


def paired_tests(result: DatasetResult, rng: np.random.Generator) -> list[Json]:
    """Every pair of methods on every tested metric: the mean difference with its 95 % interval, and
    its p-value, corrected over all of them."""
    tested = [
        (region, name)
        for region, metrics in (
            ("map", METRICS),
            ("unobserved", METRICS),
            ("map", PLAN_METRICS),
            ("unmarked", PLAN_METRICS),
        )
        for name, metric in metrics.items()
        if region in metric.tested and (region != "unmarked" or result.marks_unknown)
    ]
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
    for row, corrected in zip(rows, holm([row["p"] for row in rows]).tolist(), strict=True):
        row["p_holm"] = corrected
    return rows
