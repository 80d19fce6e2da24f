"""One method studied on one map, also over thresholds."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec
from scenegen.model.calibration import corrected
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import BenchConfig, StudyConfig
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS, measure
from scenegen.model.evaluation.planning.measure import run_trial
from scenegen.model.evaluation.statistics import figure
from scenegen.model.evaluation.study import calibration, planning
from scenegen.model.evaluation.study.calibration import JUDGED, PARTS, judge_bounds
from scenegen.model.evaluation.study.planning import fields_of, run_variants, variants
from scenegen.model.evaluation.visibility import UNOBSERVED, UNSCORED
from scenegen.sample import Sample
from scenegen.truth import distance_field

SHOWN = ("precision", "recall", "iou")
"""Metrics of a map at a threshold; `success` of a trial is beside them."""
PLACES = [list(METRICS).index(name) for name in SHOWN]


def chosen(by_probability: bool, study: StudyConfig) -> tuple[str, tuple[float, ...]]:
    """The name in `Thresholds` of what a method is cut by, and where."""
    return (
        ("probability", study.curve_probabilities)
        if by_probability
        else ("distance_m", study.curve_distances_m)
    )


def run_thresholds(
    said: Prediction,
    truth: tuple[NDArray[np.bool_], NDArray[np.float32]],
    goals: NDArray[np.float64],
    grid: GridSpec,
    config: BenchConfig,
    *,
    classes: NDArray[np.uint8],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One map at each threshold: the metrics (thresholds, SHOWN), and which trials succeed (goals,
    thresholds). Voxels whose `classes` (*grid.shape) are not 0 are not scored."""
    name, values = chosen(said.occupancy_probability is not None, config.variants)
    maps, trials = np.empty((len(values), len(SHOWN))), np.empty((len(goals), len(values)))
    for n, value in enumerate(values):
        at = dataclasses.replace(Thresholds(), **{name: value})
        cut = said.occupied(at), said.distance(at, grid)
        maps[n] = measure(
            *cut, *truth, classes=classes, class_count=1, config=config.reconstruction
        )[0, PLACES]
        trials[:, n] = [run_trial(*cut, *truth, goal, grid, config.plan).success for goal in goals]
    return maps, trials


def thresholds_of(
    maps: NDArray[np.float64],
    trials: NDArray[np.float64],
    worlds: NDArray[np.int64],
    trial_worlds: NDArray[np.int64],
    by_probability: bool,
    study: StudyConfig,
) -> list[dict[str, Any]]:
    """The report of maps (N, thresholds, SHOWN) and trials (trials, thresholds): a row a
    threshold."""
    name, values = chosen(by_probability, study)
    return [
        {"by": name, "value": value}
        | {
            metric: figure(maps[:, n, m], worlds, METRICS[metric].scale)
            for m, metric in enumerate(SHOWN)
        }
        | {"success": figure(trials[:, n], trial_worlds, PLAN_METRICS["success"].scale)}
        for n, value in enumerate(values)
    ]


@dataclass(frozen=True, eq=False, kw_only=True)
class Study:
    """What was found out about one method, of one map, or of all N maps of a dataset, stacked."""

    by_range: NDArray[np.float64]
    """([N,] bins, metrics): the reconstruction by distance from the sensor."""
    reliability: NDArray[np.float64] | None
    """([N,] ...): see `calibration.count`; None where no probability is predicted."""
    trials: NDArray[np.float64]
    """(trials, variants, columns): see `run_variants`."""
    risks: tuple[float, ...]
    """The risks of the method's bounds; () for none."""
    bounds: NDArray[np.float64]
    """([N,] risks, regions, figures): see `judge_bounds`."""
    ause: NDArray[np.float64]
    """([N]): of the bounds; NaN without any."""
    curve: NDArray[np.float64]
    """([N,] thresholds, metrics): see `run_thresholds`."""
    curve_trials: NDArray[np.float64]
    """(trials, thresholds): which succeed."""
    settings: tuple[planning.Setting, ...]
    """What the careful planner goes by."""
    careful: NDArray[np.float64]
    """(trials, settings, figures): see `run_settings`."""


def study_map(
    said: Prediction,
    occupied: NDArray[np.bool_],
    distance: NDArray[np.float32],
    sample: Sample,
    *,
    classes: NDArray[np.uint8],
    seen: NDArray[np.bool_],
    goals: NDArray[np.float64],
    grid: GridSpec,
    config: BenchConfig,
) -> Study:
    """Study what a method `said` of a sample's map, whose two maps by the paper's thresholds are
    `occupied` and `distance`; `classes` tells how each voxel was seen (`classify`), `seen` what
    returned (`seen_occupancy`)."""
    truth = sample.occupancy, sample.tudf
    bins, edges = ranges(grid, config.variants.range_step_m)
    unknown, probability = np.isin(classes, UNOBSERVED), said.occupancy_probability
    scored = classes != UNSCORED
    bits = calibration.regions(
        scored,
        unknown,
        distance,
        sample.tudf,
        distance_field(seen, grid),
        near_m=config.reconstruction.near_m,
        truncation_m=grid.truncation_m,
    )
    reliability = None
    if probability is not None:
        readings = (
            probability,
            corrected(probability, config.variants.class_weight),
            said.probability,
        )
        reliability = calibration.count(
            [one for one in readings if one is not None], sample.occupancy, bits
        )
    risks = () if said.uncertainty is None else said.uncertainty.risks
    judged, sparse = np.empty((0, len(PARTS), len(JUDGED))), np.nan
    if risks:
        judged, sparse = judge_bounds(said, distance, sample.tudf, bits)
    settings = planning.settings(said, config.variants)
    chosen, fields = variants(config.plan, config.variants), fields_of(said, occupied, grid)
    unscored = np.where(scored, np.uint8(0), np.uint8(UNSCORED))
    curve, curve_trials = run_thresholds(said, truth, goals, grid, config, classes=unscored)
    return Study(
        by_range=measure(
            occupied,
            distance,
            *truth,
            classes=np.where(scored, bins, UNSCORED),
            class_count=len(edges) - 1,
            config=config.reconstruction,
        )[2:],
        reliability=reliability,
        trials=run_variants(chosen, occupied, fields, truth, seen, goals, grid, config.plan),
        risks=risks,
        bounds=judged,
        ause=np.array(sparse),
        curve=curve,
        curve_trials=curve_trials,
        settings=settings,
        careful=planning.run_settings(settings, said, truth, goals, grid, config.plan),
    )


def stack(parts: Sequence[Study], turns: Sequence[tuple[int, int]]) -> Study:
    """The studies of all maps as one, with those trials that `turns` name, each (trial, map)."""
    counted = [part.reliability for part in parts]
    trials, careful, curve_trials = (
        np.array([getattr(parts[n], name)[turn] for turn, n in turns]).reshape(
            len(turns), *getattr(parts[0], name).shape[1:]
        )
        for name in ("trials", "careful", "curve_trials")
    )
    return Study(
        by_range=np.array([part.by_range for part in parts]),
        reliability=np.array(counted) if all(one is not None for one in counted) else None,
        trials=trials,
        risks=parts[0].risks,
        bounds=np.array([part.bounds for part in parts]),
        ause=np.array([part.ause for part in parts]),
        curve=np.array([part.curve for part in parts]),
        curve_trials=curve_trials,
        settings=parts[0].settings,
        careful=careful,
    )


@functools.cache
def ranges(grid: GridSpec, step_m: float) -> tuple[NDArray[np.uint8], tuple[float, ...]]:
    """How far each voxel's centre (*grid.shape) is from the map's middle, where the sensor is: the
    number of its bin; and the edges of the bins, `step_m` wide, metres."""
    middle = 0.5 * (np.array(grid.shape) - 1)
    away = (
        np.sqrt(sum((np.indices(grid.shape)[axis] - middle[axis]) ** 2 for axis in range(3)))
        * grid.voxel_m
    )
    count = min(math.floor(float(away.max()) / step_m) + 1, UNSCORED)
    bins = np.minimum(away / step_m, count - 1).astype(np.uint8)
    return bins, tuple(step_m * n for n in range(count + 1))
