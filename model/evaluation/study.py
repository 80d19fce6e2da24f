"""The study that the bench makes on request: whether what a method says of its sureness is so, and
what a planner makes of it that asks for a risk."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from lidarsim.grid import Field, Floats, GridSpec, Ints, Mask
from scenegen.files import Json
from scenegen.model.calibration import corrected
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import BenchConfig, LossConfig, PlanConfig, Thresholds
from scenegen.model.evaluation.planning.measure import judge, met, plan_trial
from scenegen.model.evaluation.statistics import brief, interval, summarise
from scenegen.model.evaluation.uncertainty import (
    JUDGED,
    PARTS,
    SCORES,
    bounds_of,
    count,
    judge_bounds,
    regions,
    reliability,
)
from scenegen.model.evaluation.visibility import UNOBSERVED, UNSCORED, Case, seen_occupancy
from scenegen.truth import distance_field

CLASS_WEIGHT = LossConfig().occupied_weight
"""The weight of occupied voxels in the loss by which networks are taken to be trained, which is
inverted."""
FIXED = {"probability": (0.1, 0.3, 0.5, 0.7, 0.85), "distance": (0.2, 0.4, 0.6)}
"""Thresholds beside which a planner by risk is set: of probability, or, for methods that predict
distances alone, of those, metres."""
TOLD = ("success", "collided", "abstained", "length", "min_clearance")
"""Figures of a trial."""
OUTCOMES = TOLD[:3]
CHANCES = ("independent", "worst_voxel")
"""How likely a path was said to collide, from the calibrated probabilities of the voxels that it
meets: were these independent, or were the likeliest alone to count. The truth lies between, where
voxels are occupied together."""
EDGES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Bins of these."""
SHOWN = ("map", "unobserved", "seen", "unseen")
"""Regions over which the tables show probabilities."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What the careful planner goes by."""

    by: str
    """``risk`` of the bounds; or a fixed threshold of ``probability`` or of ``distance``,
    metres."""
    value: float
    promised: float | None = None
    """What share of its paths collides at most, as the method's calibration has it; None where it
    does not say."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Study:
    """What was found out about one method on one map."""

    counts: Floats
    """See `scenegen.model.evaluation.uncertainty.count`."""
    bounds: Floats
    """(risks, PARTS, JUDGED): see `judge_bounds`."""
    ause: float
    """The bounds'; NaN without any."""
    settings: tuple[Setting, ...]
    """What the careful planner goes by, the risks of the bounds first."""
    careful: Floats
    """(goals, settings, figures): see `run_settings`."""


def study_map(prediction: Prediction, case: Case, goals: Floats, config: BenchConfig) -> Study:
    """Study what a method predicts of a sample's map, and paths on it to `goals` (trials, 3)."""
    sample, grid = case.sample, case.grid
    distance = prediction.distance(config.thresholds, grid)
    probability, calibrated = prediction.occupancy_probability, prediction.probability
    inside = regions(
        case.classes != UNSCORED,
        np.isin(case.classes, UNOBSERVED),
        distance,
        sample.tudf,
        distance_field(seen_occupancy(sample, case.split), grid),
        truncation_m=grid.truncation_m,
    )
    weight = getattr(prediction.uncertainty, "class_weight", CLASS_WEIGHT)
    readings = [] if probability is None else [probability, corrected(probability, weight)]
    readings += [] if calibrated is None else [calibrated]
    bounds, ause = judge_bounds(prediction, distance, sample.tudf, inside, grid.truncation_m)
    settings, truth = settings_of(prediction), (sample.occupancy, sample.tudf)
    return Study(
        counts=count(readings, sample.occupancy, inside),
        bounds=bounds,
        ause=ause,
        settings=settings,
        careful=run_settings(settings, prediction, truth, goals, grid, config.plan),
    )


def settings_of(said: Prediction) -> tuple[Setting, ...]:
    """Every risk that a method has bounds of, and the fixed thresholds of what it predicts."""
    by = "distance" if said.occupancy_probability is None else "probability"
    fixed = tuple(Setting(by=by, value=value) for value in FIXED[by])
    risks = () if said.uncertainty is None else said.uncertainty.risks
    promised = getattr(said.uncertainty, "path_risks", ()) or (None,) * len(risks)
    bounds = (
        Setting(by="risk", value=risk, promised=most)
        for risk, most in zip(risks, promised, strict=True)
    )
    return (*bounds, *fixed)


def run_settings(
    chosen: Sequence[Setting],
    said: Prediction,
    truth: tuple[Mask, Field],
    goals: Floats,
    grid: GridSpec,
    plan: PlanConfig,
) -> Floats:
    """Every trial of one map at each setting, (goals, settings, TOLD and then CHANCES); NaN for
    what a trial without a path, or a method without calibrated probabilities, lacks."""
    found = np.full((len(goals), len(chosen), len(TOLD) + len(CHANCES)), np.nan)
    chance, careful = said.probability, replace(plan, planner="careful")
    for s, setting in enumerate(chosen):
        blocked, field = _maps(setting, said, grid)
        for g, goal in enumerate(goals):
            found_path, path = plan_trial(blocked, field, None, goal, grid, careful)
            trial = judge(found_path, path, *truth, grid)
            planned = path is not None
            found[g, s, : len(TOLD)] = (
                trial.success,
                planned and not trial.success,
                not planned,
                trial.length_m,
                trial.min_clearance_m,
            )
            if path is not None and chance is not None:
                on_way = chance.reshape(-1)[met(path, grid)].astype(np.float64)
                sure = np.minimum(on_way, 1 - 1e-7)
                free = np.log1p(-sure)
                found[g, s, len(TOLD) :] = -np.expm1(free.sum()), -np.expm1(free.min())
    return found


def _maps(setting: Setting, said: Prediction, grid: GridSpec) -> tuple[Mask, Field]:
    """The collision map and the field that a setting makes of a prediction."""
    if setting.by == "risk":
        low = said.low(setting.value)
        return low <= 0, low
    # one of the two counts: `settings_of` chose by it
    at = Thresholds(probability=setting.value, distance_m=setting.value)
    return said.occupied(at), said.distance(at, grid)


def study_of(
    studies: Sequence[Study],
    careful: Sequence[Floats],
    worlds: Ints,
    trial_worlds: Ints,
) -> Json:
    """What was studied of one method, as JSON: its ``reliability`` and ``bounds``, None where it
    has none, from the `studies` of N maps of `worlds` (N,); and the careful planner's ``risk`` from
    the `careful` rows of all trials. Figures are {mean, std, low, high, n}, as in the tables."""
    settings = studies[0].settings
    risks = tuple(setting.value for setting in settings if setting.by == "risk")
    found = reliability(np.array([one.counts for one in studies]), worlds)
    bounds, sparse = (
        np.array([getattr(one, name) for one in studies]) for name in ("bounds", "ause")
    )
    return {
        "reliability": found or None,
        "bounds": bounds_of(bounds, sparse, risks, worlds) if risks else None,
        "risk": careful_report(
            np.array(careful).reshape(len(careful), len(settings), len(TOLD) + len(CHANCES)),
            settings,
            trial_worlds,
        ),
    }


def careful_report(trials: Floats, chosen: Sequence[Setting], worlds: Ints) -> Json:
    """The report of all trials (trials, settings, ...): a row a setting, and, by how likely paths
    were said to collide, how many did, over all settings."""
    rows = [
        asdict(setting)
        | {
            name: summarise(trials[:, s, n], worlds, "outcome" if name in OUTCOMES else "amount")
            for n, name in enumerate((*TOLD, *CHANCES))
        }
        for s, setting in enumerate(chosen)
    ]
    collided = trials[:, :, TOLD.index("collided")].reshape(-1)
    world_of = np.repeat(worlds, len(chosen))
    paths: dict[str, list[Json]] = {name: [] for name in CHANCES}
    for n, name in enumerate(CHANCES, start=len(TOLD)):
        chances = trials[:, :, n].reshape(-1)
        for low, high in pairwise(EDGES):
            inside = (chances >= low) & ((chances < high) | (high == EDGES[-1]))
            if inside.any():
                paths[name].append(
                    {
                        "from": low,
                        "to": high,
                        "said": float(chances[inside].mean()),
                        "paths": int(inside.sum()),
                        "collided": summarise(collided[inside], world_of[inside], "outcome"),
                    }
                )
    return {"settings": rows, "paths": paths}


def study_tables(study: Json) -> list[tuple[Any, ...]]:
    """What `study_of` gave of every method, for people: tables by title, heads and rows; none where
    nothing was studied."""
    columns = ("promised", *TOLD, *CHANCES)
    probabilities, planning, bounds = [], [], []
    for name, studied in study.items():
        for region in SHOWN:
            for reading, scores in (studied["reliability"] or {}).get(region, {}).items():
                # the interval of the first, the calibration error, stands beside it
                summaries = [{**scores, "mean": scores["ece"]}]
                summaries += [scores[score] for score in SCORES[1:]]
                cells = [f"{one['mean']:.4f} {interval(one, '.4f')}" for one in summaries]
                probabilities.append((f"{name}, {region}, {reading}", cells))
        for row in studied["risk"]["settings"]:
            promised = "–" if row["promised"] is None else f"{row['promised']:.3f}"
            cells = [promised, *(brief(row[column]) for column in columns[1:])]
            planning.append((f"{name}, {row['by']} {row['value']:g}", cells))
        if studied["bounds"]:
            ause = brief(studied["bounds"]["ause"])
            for row in studied["bounds"]["risks"]:
                cells = [*(_judged(row[part]) for part in PARTS), ause]
                bounds.append((f"{name}, risk {row['risk']:g}", cells))
    tables = (
        ("Probabilities", ("ECE", "NLL", "Brier"), probabilities),
        ("Bounds: coverage, and width in metres", (*PARTS, "AUSE"), bounds),
        ("The careful planner", columns, planning),
    )
    return [table for table in tables if table[-1]]


def _judged(part: Json) -> str:
    """Coverage and width of bounds over one part of the map."""
    means = [part[judged]["mean"] for judged in JUDGED]
    return ", ".join("–" if mean is None else f"{mean:.3f}" for mean in means)
