"""The planning protocol varied: how A* searches, what refines, how much clearance counts; and why
trials fail."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import PlanConfig, StudyConfig
from scenegen.model.evaluation.metrics import PLAN_METRICS
from scenegen.model.evaluation.planning.astar import Plan, plan_path
from scenegen.model.evaluation.planning.measure import Measurement, follow
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
