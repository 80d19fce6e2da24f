"""The study's figures as JSON, and as Markdown."""

import dataclasses
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.statistics import figure, head, interval, line
from scenegen.model.evaluation.study.calibration import (
    JUDGED,
    PARTS,
    READINGS,
    SCORES,
    bounds_of,
    reliability,
)
from scenegen.model.evaluation.study.maps import Study, ranges, thresholds_of
from scenegen.model.evaluation.study.planning import (
    CHANCES,
    COLUMNS,
    FATES,
    SEARCHES,
    TOLD,
    Variant,
    risk_of,
    variants,
)

if TYPE_CHECKING:
    from scenegen.model.evaluation.run import DatasetResult, MethodResult

VARIED = {"search": "what A* asks", "clearance_weight": "λ_c", "safety_m": "d_s, metres"}
"""The choices of a row of ``planning`` besides its field: names and titles."""
SUCCESS, FATE = COLUMNS.index("success"), COLUMNS.index("fate")
SHOWN = ("map", "unobserved", "seen", "unseen")
"""Regions over which the tables show probabilities."""


def study_of(result: "DatasetResult") -> dict[str, Any]:
    """What was studied on one dataset, by method: ``planning``, a row a variant;
    ``success_by_clearance``; ``by_range``; ``reliability``; ``bounds``; ``risk``; ``thresholds``.
    Figures are {mean, std, low, high, n}, as in the tables."""
    return {name: _method(found, result) for name, found in result.methods.items()}


def _method(found: "MethodResult", result: "DatasetResult") -> dict[str, Any]:
    study, config = found.study, result.config.variants
    assert study is not None
    edges = ranges(result.grid, config.range_step_m)[1]
    by_range = [
        {"from_m": low, "to_m": high}
        | {
            name: figure(study.by_range[:, b, m], result.worlds, metric.scale)
            for m, (name, metric) in enumerate(METRICS.items())
        }
        for b, (low, high) in enumerate(pairwise(edges))
    ]
    counted = study.reliability
    return {
        "planning": _planning(study, variants(result.config.plan, config), result.trial_worlds),
        "success_by_clearance": _by_clearance(found, result),
        "by_range": by_range,
        "reliability": None
        if counted is None
        else {"class_weight": config.class_weight, **reliability(counted, result.worlds)},
        "bounds": bounds_of(study.bounds, study.ause, study.risks, result.worlds)
        if study.risks
        else None,
        "risk": risk_of(study.careful, study.settings, result.trial_worlds),
        "thresholds": thresholds_of(
            study.curve,
            study.curve_trials,
            result.worlds,
            result.trial_worlds,
            counted is not None,
            config,
        ),
    }


def _planning(
    study: Study, chosen: tuple[Variant, ...], worlds: np.ndarray
) -> list[dict[str, Any]]:
    """A row a variant whose field the method has: its choices, metrics and fates, and by how much
    more or fewer of the same trials succeed than with the transform of the method's occupancy as
    the field."""
    rows = []
    for v, variant in enumerate(chosen):
        trials = study.trials[:, v]
        if len(trials) and np.isnan(trials[:, FATE]).all():
            continue
        row = dataclasses.asdict(variant)
        row |= {
            name: figure(trials[:, c], worlds, metric.scale)
            for c, (name, metric) in enumerate(PLAN_METRICS.items())
        }
        row["fates"] = {name: int((trials[:, FATE] == n).sum()) for n, name in enumerate(FATES)}
        if variant.field != "edt":
            other = study.trials[
                :, chosen.index(dataclasses.replace(variant, field="edt")), SUCCESS
            ]
            row["success_against_edt"] = figure(trials[:, SUCCESS] - other, worlds, "gain")
        rows.append(row)
    return rows


def _by_clearance(found: "MethodResult", result: "DatasetResult") -> list[dict[str, Any]]:
    """Success by how tight a trial is: the least clearance of the path that the same planner finds
    on the truth."""
    step, success = (
        result.config.variants.clearance_step_m,
        np.array([trial.success for trial in found.trials], float),
    )
    bins = np.floor(result.trial_clearance / step + 1e-9).astype(int)
    return [
        {
            "from_m": step * b,
            "to_m": step * (b + 1),
            "success": figure(np.where(bins == b, success, np.nan), result.trial_worlds, "outcome"),
        }
        for b in range(bins.max(initial=-1) + 1)
    ]


def study_lines(study: Mapping[str, Any]) -> list[str]:
    """What `study_of` gave of planning and calibration, as Markdown for people; nothing where
    nothing was studied."""
    if not study:
        return []
    lines = [line for varied in VARIED for line in success_lines(study, varied)] + fate_lines(study)
    return (
        lines
        + threshold_lines(study)
        + _probability_lines(study)
        + _bounds_lines(study)
        + _risk_lines(study)
    )


def success_lines(study: Mapping[str, Any], varied: str) -> list[str]:
    """Success of every method and field over the choices of one of `VARIED`, as a Markdown
    table."""
    usual = next(iter(study.values()))["planning"][0]
    rows = [
        (name, row) for name, found in study.items() for row in at(found["planning"], usual, varied)
    ]
    values = list(SEARCHES) if varied == "search" else sorted({row[varied] for _, row in rows})
    cells = {(f"{name}, {row['field']}", row[varied]): brief(row["success"]) for name, row in rows}
    names = dict.fromkeys(name for name, _ in cells)
    lines = ["", f"### Success by {VARIED[varied]}", "", *head([str(value) for value in values])]
    return lines + [line(name, (cells[name, value] for value in values)) for name in names]


def fate_lines(study: Mapping[str, Any]) -> list[str]:
    """What became of every method's trials, by field, as a Markdown table."""
    usual = next(iter(study.values()))["planning"][0]
    return ["", "### What became of trials", "", *head(FATES)] + [
        line(f"{name}, {row['field']}", (str(row["fates"][fate]) for fate in FATES))
        for name, found in study.items()
        for row in at(found["planning"], usual)
    ]


def threshold_lines(study: Mapping[str, Any]) -> list[str]:
    """Precision, IoU and success of every method over thresholds: a Markdown table for each kind of
    threshold."""
    lines: list[str] = []
    curves = {name: found["thresholds"] for name, found in study.items() if found["thresholds"]}
    for by in dict.fromkeys(curve[0]["by"] for curve in curves.values()):
        rows = {name: curve for name, curve in curves.items() if curve[0]["by"] == by}
        values = [f"{row['value']:g}" for row in next(iter(rows.values()))]
        lines += ["", f"### Precision, IoU and success by threshold: {by}", "", *head(values)]
        for name, curve in rows.items():
            lines.append(
                line(
                    name,
                    (
                        " · ".join(_short(row[one]) for one in ("precision", "iou", "success"))
                        for row in curve
                    ),
                )
            )
    return lines


def _short(figure: Mapping[str, Any]) -> str:
    return f"{figure['mean']:.3f}" if figure["n"] else "–"


def _probability_lines(study: Mapping[str, Any]) -> list[str]:
    lines = [
        "",
        "### Probabilities",
        "",
        "| method, voxels, reading | ECE | NLL | Brier |",
        "|---|---|---|---|",
    ]
    for name, found in study.items():
        held = found["reliability"] or {}
        for region, reading in ((region, reading) for region in SHOWN for reading in READINGS):
            if (one := held.get(region, {}).get(reading)) is not None:
                figures = ({**one, "mean": one["ece"]}, *(one[score] for score in list(SCORES)[1:]))
                cells = (f"{figure['mean']:.4f} {interval(figure, '.4f')}" for figure in figures)
                lines.append(line(f"{name}, {region}, {reading}", cells))
    return lines


def _bounds_lines(study: Mapping[str, Any]) -> list[str]:
    lines: list[str] = []
    for name, found in study.items():
        if (held := found["bounds"]) is None:
            continue
        lines += ["", f"### Bounds of {name}: coverage, and width in metres", ""]
        lines += [
            f"AUSE {brief(held['ause'])}",
            "",
            *head([f"risk {row['risk']:g}" for row in held["risks"]]),
        ]
        for part in PARTS:
            cells = [[row[part][judged] for judged in JUDGED] for row in held["risks"]]
            shown = [
                ", ".join("–" if one["mean"] is None else f"{one['mean']:.3f}" for one in pair)
                for pair in cells
            ]
            lines.append(line(part, shown))
    return lines


def _risk_lines(study: Mapping[str, Any]) -> list[str]:
    names = ("promised", *TOLD, *CHANCES)
    lines = ["", "### The careful planner", "", *head(names)]
    for name, found in study.items():
        for row in found["risk"]["settings"]:
            promised = "–" if row["promised"] is None else f"{row['promised']:.3f}"
            lines.append(
                line(
                    f"{name}, {row['by']} {row['value']:g}",
                    (promised, *(brief(row[one]) for one in names[1:])),
                )
            )
    return lines


def at(
    rows: Iterable[Mapping[str, Any]], usual: Mapping[str, Any], varied: str = ""
) -> list[Mapping[str, Any]]:
    """Those rows of ``planning`` that are as `usual` in all choices but the field and the one that
    is `varied`."""
    return [
        row for row in rows if all(row[name] == usual[name] for name in VARIED if name != varied)
    ]


def brief(figure: Mapping[str, Any]) -> str:
    """A mean and its interval; a dash where nothing was measured."""
    return f"{figure['mean']:.3f} {interval(figure, '.3f')}" if figure["n"] else "–"
