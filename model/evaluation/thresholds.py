"""The threshold at which the occupancy that a method predicts fits the truth best: one rule for the
bench and for training."""

from dataclasses import replace

import numpy as np

from lidarsim.grid import Floats, Mask
from lidarsim.jit import kernel
from scenegen.dataset.read import AnyDataset
from scenegen.display.look import evenly
from scenegen.model.completion.protocol import Prediction, plain
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.methods import Method
from scenegen.scored import scored_voxels

MAX_TUNING_SAMPLES = 50
"""Validation samples on which the bench tunes thresholds, at most."""
CANDIDATES = {
    "probability": np.arange(0.05, 1.0, 0.05).round(4),
    "distance_m": np.arange(0.05, 0.85, 0.05).round(4),
}
"""The thresholds that are tried, by the field of `Thresholds`."""


def judged_by(prediction: Prediction) -> str:
    """The field of `Thresholds` that decides which voxels of a prediction are occupied."""
    return "distance_m" if prediction.occupancy_probability is None else "probability"


def ious_by_threshold(prediction: Prediction, truth: Mask, scored: Mask) -> Floats:
    """IoU at every candidate of the prediction's threshold, from one histogram.

    Args:
        prediction: Of one map, of shape (*grid.shape).
        truth: Occupied voxels (*grid.shape).
        scored: The voxels (*grid.shape) that count.

    Returns:
        (candidates,): `lidarsim.grid.iou` of ``prediction.occupied(thresholds)`` and the truth.
    """
    name = judged_by(prediction)
    edges = CANDIDATES[name].astype(np.float32)  # as `Prediction.occupied` compares
    by_probability = name == "probability"
    values = plain(prediction.occupancy_probability if by_probability else prediction.tudf)
    values = values.astype(np.result_type(values, np.float32))  # halves and bits, too
    counts = np.zeros((2, len(edges) + 1), np.int64)
    grids = [np.ascontiguousarray(grid).reshape(-1) for grid in (values, truth, scored)]
    _count(*grids, edges, not by_probability, counts)  # type: ignore[call-arg]
    alarms, hits = counts.cumsum(axis=1)[:, :-1]  # of voxels that pass at most n edges, for edge n
    free, occupied = counts.sum(axis=1)
    if by_probability:
        alarms, hits = free - alarms, occupied - hits
    union = alarms + occupied
    return np.where(union, hits / np.maximum(union, 1), 1.0)


@kernel
def _count(values, truth, scored, edges, ties, counts):
    """Count the scored voxels (voxels,) by the truth and by how many `edges` their value exceeds,
    or, with `ties`, reaches."""
    for v in range(len(values)):
        if scored[v]:
            passed = 0
            while passed < len(edges) and (
                edges[passed] < values[v] or (ties and edges[passed] == values[v])
            ):
                passed += 1
            counts[1 if truth[v] else 0, passed] += 1


def best_of(name: str, ious: Floats, usual: Thresholds) -> Thresholds:
    """The candidate (the first of equal ones) with the largest of the mean `ious` (candidates,), in
    the field `name` of `usual`; `usual` itself if all are equal."""
    if np.ptp(ious) < 1e-12:
        return usual
    return replace(usual, **{name: float(CANDIDATES[name][int(ious.argmax())])})


def tune(method: Method, dataset: AnyDataset, thresholds: Thresholds) -> Thresholds:
    """The thresholds at which `method` has the largest mean IoU on at most `MAX_TUNING_SAMPLES`
    validation samples, evenly spread: the same rule for every method.

    If all do equally well, or the method predicts nothing of the validation split, `thresholds`.
    """
    split = dataset.split("val")
    rows, name = [], ""
    for index in evenly(len(split), MAX_TUNING_SAMPLES) if len(split) else ():
        sample = split[index]
        try:
            completion = method.completion(sample, split)
        except KeyError:  # a file that predicts the test split alone
            return thresholds
        name = judged_by(completion)
        scored = scored_voxels(sample, dataset.grid, split.home(index).tables.world)
        rows.append(ious_by_threshold(completion, sample.occupancy, scored))
    return best_of(name, np.mean(rows, axis=0), thresholds) if rows else thresholds
