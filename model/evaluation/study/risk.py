"""The careful planner over its risk, beside the same planner with fixed thresholds; and whether
paths collide as often as they were said to."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import PlanConfig, StudyConfig
from scenegen.model.evaluation.planning.careful import plan_carefully
from scenegen.model.evaluation.statistics import figure
from scenegen.truth import distance_field

TOLD = ("success", "collided", "abstained", "length", "min_clearance")
"""Figures of a trial."""
OUTCOMES = TOLD[:3]
CHANCES = ("independent", "worst_voxel")
"""How likely a path was said to collide, from the calibrated probabilities of the voxels that it
meets: were these independent, or were the likeliest alone to count. The truth lies between, where
voxels are occupied together."""
EDGES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Bins of these."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What the planner goes by."""

    by: str
    """``risk`` of the bounds; or a fixed threshold of ``probability`` or of ``distance``,
    metres."""
    value: float
    promised: float | None = None
    """What share of its paths collides at most, as the method's calibration has it; None where it
    does not say."""


def settings(said: Prediction, study: StudyConfig) -> tuple[Setting, ...]:
    """Every risk that a method has bounds of, and the fixed thresholds of what it predicts."""
    if said.occupancy_probability is None:
        fixed = [Setting(by="distance", value=value) for value in study.fixed_distances_m]
    else:
        fixed = [Setting(by="probability", value=value) for value in study.fixed_probabilities]
    if said.uncertainty is None:
        return tuple(fixed)
    risks = said.uncertainty.risks
    promised = getattr(said.uncertainty, "path_risks", ()) or (None,) * len(risks)
    bounds = [
        Setting(by="risk", value=risk, promised=most)
        for risk, most in zip(risks, promised, strict=True)
    ]
    return (*bounds, *fixed)


def run_settings(
    chosen: Sequence[Setting],
    said: Prediction,
    truth: tuple[NDArray[np.bool_], NDArray[np.float32]],
    goals: NDArray[np.float64],
    grid: GridSpec,
    plan: PlanConfig,
) -> NDArray[np.float64]:
    """Every trial of one map at each setting, (goals, settings, TOLD and then CHANCES); NaN for
    what a trial without a path, or a method without calibrated probabilities, lacks."""
    found = np.full((len(goals), len(chosen), len(TOLD) + len(CHANCES)), np.nan)
    chance = said.probability
    free = (
        None
        if chance is None
        else np.log1p(-np.minimum(chance.reshape(-1).astype(np.float64), 1 - 1e-7))
    )
    for s, setting in enumerate(chosen):
        blocked, field = _maps(setting, said, grid)
        for g, goal in enumerate(goals):
            done = plan_carefully(blocked, field, goal, grid, plan)
            trial = done.judged(*truth, grid, plan)
            planned = done.path is not None
            figures = (
                trial.success,
                planned and not trial.success,
                not planned,
                trial.length_m,
                trial.min_clearance_m,
            )
            found[g, s, : len(TOLD)] = figures
            if planned and free is not None:
                on_path = free[done.voxels]
                found[g, s, len(TOLD) :] = -np.expm1(on_path.sum()), -np.expm1(on_path.min())
    return found


def _maps(
    setting: Setting, said: Prediction, grid: GridSpec
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """The collision map and the field that a setting makes of a prediction."""
    if setting.by == "risk":
        low = said.low(setting.value)
        return low <= 0, low
    name = "probability" if setting.by == "probability" else "distance_m"
    blocked = said.occupied(dataclasses.replace(Thresholds(), **{name: setting.value}))
    return blocked, distance_field(blocked, grid) if said.tudf is None else said.tudf


def risk_of(
    trials: NDArray[np.float64], chosen: Sequence[Setting], worlds: NDArray[np.int64]
) -> dict[str, Any]:
    """The report of all trials (trials, settings, ...): a row a setting, and, by how likely paths
    were said to collide, how many did, over all settings."""
    rows = [
        dataclasses.asdict(setting)
        | {
            name: figure(trials[:, s, n], worlds, "outcome" if name in OUTCOMES else "amount")
            for n, name in enumerate((*TOLD, *CHANCES))
        }
        for s, setting in enumerate(chosen)
    ]
    collided = trials[:, :, TOLD.index("collided")].reshape(-1)
    repeated = np.repeat(worlds, len(chosen))
    paths: dict[str, list[dict[str, Any]]] = {}
    for n, name in enumerate(CHANCES, start=len(TOLD)):
        said = trials[:, :, n].reshape(-1)
        paths[name] = []
        for low, high in pairwise(EDGES):
            inside = (said >= low) & ((said < high) | (high == EDGES[-1]))
            if inside.any():
                had = figure(collided[inside], repeated[inside], "outcome")
                values = {
                    "said": float(said[inside].mean()),
                    "paths": int(inside.sum()),
                    "collided": had,
                }
                paths[name].append({"from": low, "to": high, **values})
    return {"settings": rows, "paths": paths}
