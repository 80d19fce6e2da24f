"""The study's figures as JSON."""

import dataclasses
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.statistics import figure
from scenegen.model.evaluation.study.calibration import reliability
from scenegen.model.evaluation.study.maps import Study, ranges
from scenegen.model.evaluation.study.planning import COLUMNS, FATES, Variant, variants

if TYPE_CHECKING:
    from scenegen.model.evaluation.run import DatasetResult, MethodResult

SUCCESS, FATE = COLUMNS.index("success"), COLUMNS.index("fate")


def study_of(result: "DatasetResult", rng: np.random.Generator) -> dict[str, Any]:
    """What was studied on one dataset, by method: ``planning``, a row a variant; ``success_by_clearance``;
    ``by_range``; ``reliability``. Figures are {mean, std, low, high, n}, as in the report's tables."""
    return {name: _method(found, result, rng) for name, found in result.methods.items()}


def _method(found: "MethodResult", result: "DatasetResult", rng: np.random.Generator) -> dict[str, Any]:
    study, config = found.study, result.config.variants
    assert study is not None
    edges = ranges(result.grid, config.range_step_m)[1]
    by_range = [
        {"from_m": low, "to_m": high}
        | {name: figure(study.by_range[:, b, m], result.worlds, rng=rng) for m, name in enumerate(METRICS)}
        for b, (low, high) in enumerate(pairwise(edges))
    ]
    counted = study.reliability
    return {
        "planning": _planning(study, variants(result.config.plan, config), result.trial_worlds, rng),
        "success_by_clearance": _by_clearance(found, result, rng),
        "by_range": by_range,
        "reliability": None
        if counted is None
        else {"class_weight": config.class_weight, **reliability(counted, result.worlds, rng=rng)},
    }


def _planning(
    study: Study, chosen: tuple[Variant, ...], worlds: np.ndarray, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """A row a variant whose field the method has: its choices, metrics and fates, and by how much more or fewer of the
    same trials succeed than with the transform of the method's occupancy as the field."""
    rows = []
    for v, variant in enumerate(chosen):
        trials = study.trials[:, v]
        if np.isnan(trials[:, FATE]).all():
            continue
        row = dataclasses.asdict(variant)
        row |= {name: figure(trials[:, c], worlds, rng=rng) for c, name in enumerate(PLAN_METRICS)}
        row["fates"] = {name: int((trials[:, FATE] == n).sum()) for n, name in enumerate(FATES)}
        if variant.field != "edt":
            other = study.trials[:, chosen.index(dataclasses.replace(variant, field="edt")), SUCCESS]
            row["success_against_edt"] = figure(trials[:, SUCCESS] - other, worlds, rng=rng)
        rows.append(row)
    return rows


def _by_clearance(found: "MethodResult", result: "DatasetResult", rng: np.random.Generator) -> list[dict[str, Any]]:
    """Success by how tight a trial is: the least clearance of the path that the same planner finds on the truth."""
    step, success = result.config.variants.clearance_step_m, np.array([trial.success for trial in found.trials], float)
    bins = np.floor(result.trial_clearance / step + 1e-9).astype(int)
    return [
        {
            "from_m": step * b,
            "to_m": step * (b + 1),
            "success": figure(np.where(bins == b, success, np.nan), result.trial_worlds, rng=rng),
        }
        for b in range(bins.max(initial=-1) + 1)
    ]
