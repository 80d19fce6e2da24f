"""Reliability of probabilities: calibration error, likelihood and Brier score, by region of the
map.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from lidarsim.grid import Field, Floats, Ints, Mask
from lidarsim.jit import kernel
from scenegen.base.files import Json
from scenegen.model.bench.statistics import estimate, interval
from scenegen.model.bench.visibility import UNOBSERVED, UNSCORED, Case, seen_occupancy
from scenegen.model.calibration import corrected
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import LossConfig
from scenegen.truth import distance_field

CLASS_WEIGHT = LossConfig().occupied_weight
"""The weight of occupied voxels in a network's loss, where its calibration does not say."""

BINS = 20
"""Bins of probability, equally wide."""
REGIONS = ("map", "unobserved", "seen", "unseen")
"""Voxels of the whole map; the unknown ones among them; and of these, those whose nearest obstacle
within the truncation returned something, and those whose nearest obstacle did not."""
READINGS = ("said", "corrected", "calibrated")
"""Probabilities as predicted; with the class weight of the loss inverted; and from the method's
calibration, if there is one."""
COUNTS = ("voxels", "said", "occupied", "nll", "brier")
"""Sums over the voxels in a bin: number, predicted probabilities, number of occupied voxels,
negative logarithms of the probability of the true state, and squared errors."""
SMALLEST = 1e-7
"""Replaces a probability of 0 in logarithms: one voxel would make the mean infinite."""


def count_map(prediction: Prediction, case: Case) -> Floats:
    """Count the voxels of a sample's map by predicted probability.

    Args:
        prediction: A method's prediction.
        case: The sample.

    Returns:
        See `count`.
    """
    sample, grid = case.sample, case.grid
    probability, calibrated = prediction.occupancy_probability, prediction.probability
    inside = regions(
        case.classes != UNSCORED,
        np.isin(case.classes, UNOBSERVED),
        sample.tudf,
        distance_field(seen_occupancy(sample, case.split), grid),
        truncation_m=grid.truncation_m,
    )
    # a method without a calibration does not say by which weight it was trained
    weight = getattr(prediction.calibration, "class_weight", CLASS_WEIGHT)
    readings = [] if probability is None else [probability, corrected(probability, weight)]
    readings += [] if calibrated is None else [calibrated]
    return count(readings, sample.occupancy, inside)


def regions(scored: Mask, unknown: Mask, true: Field, seen: Field, *, truncation_m: float) -> Mask:
    """Select the voxels of each of `REGIONS`.

    Args:
        scored: Voxels that count (*shape).
        unknown: Voxels that no ray crossed and that hold no return (*shape).
        true: True distances (*shape), metres.
        seen: Distances to obstacles that returned something (*shape), metres.
        truncation_m: Where distances are cut off, metres.

    Returns:
        (regions, *shape).
    """
    # at the truncation, the true distance does not say which obstacle is nearest
    met = unknown & (true < truncation_m - 1e-6)
    return np.stack([scored, unknown, met & (seen <= true), met & (seen > true)])


def count(
    readings: Sequence[Field],
    occupancy: Mask,
    inside: Mask,
) -> Floats:
    """Count the voxels of a map by predicted probability.

    Args:
        readings: Probabilities (*shape) of the first so many `READINGS`.
        occupancy: True occupancy (*shape).
        inside: Voxels of each region, (regions, *shape).

    Returns:
        (regions, READINGS, BINS, COUNTS).
    """
    counts = np.zeros((len(REGIONS), len(READINGS), BINS, len(COUNTS)))
    for n, probability in enumerate(readings):
        masks = inside.reshape(len(inside), -1)
        _count(probability.reshape(-1), occupancy.reshape(-1), masks, counts[:, n])
    return counts


@kernel
def _count(probability, occupancy, inside, counts):
    parts, bins, _ = counts.shape
    for v in range(len(probability)):
        q = float(probability[v])
        # a probability of 1 belongs to the last bin
        b = min(int(q * bins), bins - 1)
        right = q if occupancy[v] else 1.0 - q
        nll, brier = -math.log(max(right, SMALLEST)), (1.0 - right) ** 2
        for region in range(parts):
            if inside[region, v]:
                counts[region, b, 0] += 1.0
                counts[region, b, 1] += q
                counts[region, b, 2] += occupancy[v]
                counts[region, b, 3] += nll
                counts[region, b, 4] += brier


def reliability(counts: Floats, worlds: Ints) -> Json:
    """Compute the reliability of N maps.

    Probability types that a method lacks, and regions without voxels, are omitted.

    Args:
        counts: From `count`, of each map: (N, regions, readings, BINS, counts).
        worlds: The maps' worlds, (N,).

    Returns:
        By region and reading, the bins that hold voxels; and over all voxels the negative
        log-likelihood, the Brier score and the expected calibration error, the mean of |occupied −
        predicted| by bin, with 95 % intervals.
    """
    by_region: Json = {}
    for r, region in enumerate(REGIONS):
        for n, reading in enumerate(READINGS):
            maps = counts[:, r, n]
            total = maps.sum(axis=0)
            if not total[:, 0].any():
                continue
            # over the voxels of all maps together: calibration errors are of bins, not of maps
            figures = {}
            for name in SCORES:
                figure = estimate(maps.reshape(len(maps), -1), worlds, partial(_score, name))
                low, high = figure.ends
                figures[name] = {"mean": figure.value, "low": low, "high": high}
            ece = figures.pop("ece")
            bins = [
                {
                    "from": b / BINS,
                    "to": (b + 1) / BINS,
                    "voxels": int(voxels),
                    "said": p / voxels,
                    "occupied": o / voxels,
                }
                for b, (voxels, p, o, *_) in enumerate(total.tolist())
                if voxels
            ]
            by_region.setdefault(region, {})[reading] = {
                "ece": ece.pop("mean"),
                **ece,
                **figures,
                "bins": bins,
            }
    return by_region


def _score(name: str, sums: Floats) -> Floats:
    """One of `SCORES` (k,) of sums (k, BINS * counts): expected calibration errors, or means over
    voxels; NaN of no voxels."""
    counts = sums.reshape(len(sums), BINS, len(COUNTS))
    voxels, probability, occupied = np.moveaxis(counts, -1, 0)[:3]
    wrong = np.abs(probability - occupied) if name == "ece" else counts[:, :, COUNTS.index(name)]
    whole = voxels.sum(axis=1)
    return np.where(whole > 0, wrong.sum(axis=1) / np.maximum(whole, 1), np.nan)


SCORES = ("ece", "nll", "brier")
"""Scores of probabilities: calibration error, negative log-likelihood and Brier score."""


def reliability_tables(by_method: Json) -> list[tuple[Any, ...]]:
    """Tabulate `reliability` of every method by name: (title, heads, rows), one table; none if no
    method gives probabilities."""
    rows = []
    for name, by_region in by_method.items():
        for region, readings in (by_region or {}).items():
            for reading, scores in readings.items():
                # the interval of the first, the calibration error, stands beside it
                summaries = [{**scores, "mean": scores["ece"]}]
                summaries += [scores[score] for score in SCORES[1:]]
                cells = [
                    f"{summary['mean']:.4f} {interval(summary, '.4f')}" for summary in summaries
                ]
                rows.append((f"{name}, {region}, {reading}", cells))
    return [("Probabilities", ("ECE", "NLL", "Brier"), rows)] if rows else []
