"""The planning protocol varied, why trials fail, and the careful planner over its risk."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import PlanConfig, StudyConfig
from scenegen.model.evaluation.metrics import PLAN_METRICS
from scenegen.model.evaluation.planning.astar import Plan, plan_path
from scenegen.model.evaluation.planning.measure import Measurement, follow, plan_carefully
from scenegen.model.evaluation.statistics import figure
from scenegen.truth import distance_field

SEARCHES = {
    "nodes": (False, False),
    "edges": (True, False),
    "nodes, free start": (False, True),
    "edges, free start": (True, True),
}
"""What A* asks of the collision map: whether edges must be free, too, and whether the start's voxel
is free anyway (`edge_check` and `free_start` of `PlanConfig`)."""
FIELDS = ("edt", "tudf", "min")
"""What the refinement reads: the transform of the predicted occupancy, the predicted distances, or
the lesser of both in each voxel."""
FATES = ("reached", "no_path", "known", "missed", "unseen")
"""What becomes of a trial. `no_path`: A* finds none on the method's map. The others failed at the
first occupied voxel of the truth that the path meets: the method's own map held it occupied
(`known`); it did not, and the voxel belongs to an obstacle that returned something (`missed`), or
to one that did not (`unseen`)."""
COLUMNS = (*PLAN_METRICS, "fate")
"""Figures of a trial under a variant."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """The paper's protocol with other choices."""

    search: str
    """A name in `SEARCHES`."""
    field: str
    """One of `FIELDS`."""
    clearance_weight: float
    """lambda_c."""
    safety_m: float
    """d_s, metres."""


def variants(plan: PlanConfig, study: StudyConfig) -> tuple[Variant, ...]:
    """Every search and field at the weight and safety distance of `plan`; and with the start as it
    is predicted, every field at each other weight, and at each other safety distance."""
    usual = (plan.clearance_weight, plan.safety_m)
    weights = [(weight, plan.safety_m) for weight in study.clearance_weights]
    safeties = [(plan.clearance_weight, safety) for safety in study.safeties_m]
    found = [
        Variant(search=search, field=field, clearance_weight=weight, safety_m=safety)
        for search, (_, free_start) in SEARCHES.items()
        for field in FIELDS
        for weight, safety in (usual, *(() if free_start else (*weights, *safeties)))
    ]
    return tuple(dict.fromkeys(found))


def fields_of(
    said: Prediction, occupied: NDArray[np.bool_], grid: GridSpec
) -> dict[str, NDArray[np.float32]]:
    """The fields (*grid.shape), metres, that a prediction whose binary map is `occupied` offers:
    `FIELDS`, or the first alone where it holds no distances."""
    edt = distance_field(occupied, grid)
    if said.tudf is None:
        return {"edt": edt}
    tudf = said.distance(
        Thresholds(), grid
    )  # which are of no account where distances are predicted
    return {"edt": edt, "tudf": tudf, "min": np.minimum(edt, tudf)}


def run_variants(
    chosen: Sequence[Variant],
    occupied: NDArray[np.bool_],
    fields: Mapping[str, NDArray[np.float32]],
    truth: tuple[NDArray[np.bool_], NDArray[np.float32]],
    seen: NDArray[np.bool_],
    goals: NDArray[np.float64],
    grid: GridSpec,
    plan: PlanConfig,
) -> NDArray[np.float64]:
    """Every trial of one map under each variant, (goals, variants, len(COLUMNS)), fates as indices
    into `FATES`.

    `occupied` and `fields` are the method's; `truth` is occupancy and distances, `seen` the
    occupancy of the obstacles that returned something (`seen_occupancy`); all (*grid.shape). A
    variant whose field is not among `fields` has NaN throughout. Paths are searched once a goal and
    search, and refined once where two searches found the same.
    """
    found = np.full((len(goals), len(chosen), len(COLUMNS)), np.nan)
    settings = {
        one: dataclasses.replace(plan, clearance_weight=one[0], safety_m=one[1])
        for one in {(variant.clearance_weight, variant.safety_m) for variant in chosen}
    }
    for g, goal in enumerate(goals):
        plans = _search(occupied, goal, grid, plan)
        done: dict[tuple[int, str, float, float], list[float]] = {}
        for v, variant in enumerate(chosen):
            if variant.field not in fields:
                continue
            path, setting = plans[variant.search], (variant.clearance_weight, variant.safety_m)
            key = (id(path), variant.field, *setting)
            if key not in done:
                trial = follow(path, fields[variant.field], *truth, grid, settings[setting])
                figures = [float(metric.of(trial)) for metric in PLAN_METRICS.values()]
                done[key] = [*figures, FATES.index(fate(trial, occupied, seen))]
            found[g, v] = done[key]
    return found


def _search(
    occupied: NDArray[np.bool_], goal: NDArray[np.float64], grid: GridSpec, plan: PlanConfig
) -> dict[str, Plan]:
    """What each search finds: the same object where it is the same path, or none for the same
    reason."""
    plans: dict[str, Plan] = {}
    for search, (edge_check, free_start) in SEARCHES.items():
        found = plans.get(search.removesuffix(", free start"))
        if found is None or found.reason == "start_blocked":
            found = plan_path(
                occupied,
                goal,
                grid,
                dataclasses.replace(plan, edge_check=edge_check, free_start=free_start),
            )
        plans[search] = next((old for old in plans.values() if _same(old, found)), found)
    return plans


def _same(one: Plan, other: Plan) -> bool:
    if one.waypoints is None or other.waypoints is None:
        return one.reason == other.reason
    return np.array_equal(one.waypoints, other.waypoints)


def fate(trial: Measurement, occupied: NDArray[np.bool_], seen: NDArray[np.bool_]) -> str:
    """What became of a trial that a method with the binary map `occupied` made: one of `FATES`."""
    if trial.success:
        return "reached"
    if trial.hit is None:
        return "no_path"
    if occupied.flat[trial.hit]:
        return "known"
    return "missed" if seen.flat[trial.hit] else "unseen"


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
