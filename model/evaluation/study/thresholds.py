"""The tables' figures over thresholds: methods compare by curves, since one threshold suits one
method's precision."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import BenchConfig, StudyConfig
from scenegen.model.evaluation.metrics import METRICS, PLAN_METRICS
from scenegen.model.evaluation.planning.measure import run_trial
from scenegen.model.evaluation.reconstruction import measure
from scenegen.model.evaluation.statistics import figure

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
