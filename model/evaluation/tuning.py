"""Thresholds tuned for every method by the same rule: the largest mean IoU on the validation
split."""

import dataclasses

import numpy as np

from scenegen.dataset.read import Dataset
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.methods import Method
from scenegen.model.evaluation.visibility import scored_voxels

PROBABILITIES = np.arange(0.05, 1.0, 0.05)
DISTANCES_M = np.arange(0.05, 0.85, 0.05)


def spread(count: int, most: int) -> list[int]:
    """At most `most` of the numbers below `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int)).tolist()


def tune(method: Method, dataset: Dataset, *, most: int, thresholds: Thresholds) -> Thresholds:
    """The thresholds at which `method` does best on at most `most` validation samples, evenly
    spread.

    Where all do equally well, or the method says nothing about the validation split, `thresholds`
    as they are.
    """
    split = dataset.split("val")
    if not len(split):
        return thresholds
    scores: list[list[float]] = []
    name, candidates = "probability", PROBABILITIES
    for index in spread(len(split), most):
        sample = split[index]
        scored = scored_voxels(sample, dataset.grid, split.home(index).tables)
        truth = sample.occupancy[scored]
        try:
            completion = method.completion(sample, split)
        except KeyError:  # a file that predicts the test split alone
            return thresholds
        if completion.occupancy_probability is None:
            name, candidates = "distance_m", DISTANCES_M
        row = []
        for value in candidates:
            at = dataclasses.replace(thresholds, **{name: float(value)})
            occupied = completion.occupied(at)[scored]
            union = np.count_nonzero(occupied | truth)
            row.append(np.count_nonzero(occupied & truth) / union if union else 1.0)
        scores.append(row)
    means = np.mean(scores, axis=0)
    if np.ptp(means) < 1e-12:
        return thresholds
    return dataclasses.replace(
        thresholds, **{name: round(float(candidates[int(means.argmax())]), 4)}
    )
