"""A calibration from counts over validation worlds.

Voxels of one world are anything but independent, so worlds are what is exchanged: every world
counts the same, however many voxels it has, and what is promised is promised of a random unknown
voxel of a new world.

Bounds are conformal (Vovk, Gammerman and Shafer 2005; with groups: Dunn, Wasserman and Ramdas
2022). The score of a voxel is its predicted less its true distance. A bin's quantile of it is the
shape of the margin; since the shape was fitted to the same worlds, it is fitted again without each
fifth of them, and what these lack then (Barber et al. 2021) is added to every bin, so that unknown
voxels of new worlds, those predicted to be near an obstacle, and the others are covered: each by (1
- risk) (W + 1) / W of W worlds, as a new world may be the worst of all.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from lidarsim import GridSpec
from scenegen.model.uncertainty.calibration import bins, corrected_logit, distance_bins

RISKS = (0.5, 0.4, 0.3, 0.2, 0.15, 0.1, 0.07, 0.05, 0.03, 0.02, 0.01, 0.005, 0.002, 0.001)
"""Risks that bounds are made for, as far down as the worlds allow."""
STEP_M = 0.1
"""Width of the bins of predicted distance."""
CHANCES = (0.01, 0.03, 0.1, 0.3, 0.6)
"""Edges of the bins of probability, where it is predicted."""
NEAR_M = 1.0
"""Distances predicted to be less are near ones."""
SCORE_M = 0.02
"""Scores are counted in steps of this, and rounded up."""
LOGIT, MOST_LOGIT = 0.05, 20.0
"""Width of the bins of logits, and where they end."""
FOLDS = 5


def count_logits(
    probability: NDArray[np.float32],
    occupied: NDArray[np.bool_],
    unknown: NDArray[np.bool_],
    class_weight: float,
) -> NDArray[np.int64]:
    """How many of a map's `unknown` voxels have which logit, the class weight inverted: (logits,
    2), free and occupied ones apart. The arrays have one shape."""
    steps = (corrected_logit(probability[unknown], class_weight) + MOST_LOGIT) / LOGIT
    at = np.clip(steps.astype(np.int64), 0, len(_logits()) - 1)
    return np.bincount(2 * at + occupied[unknown], minlength=2 * len(_logits())).reshape(-1, 2)


def fit_temperature(counts: NDArray[np.int64]) -> float:
    """The temperature (Guo et al. 2017) at which counted logits (logits, 2) have the least negative
    log-likelihood."""

    def loss(log_temperature: float) -> float:
        scaled = _logits() / math.exp(log_temperature)
        return float(
            counts[:, 0] @ np.logaddexp(0, scaled) + counts[:, 1] @ np.logaddexp(0, -scaled)
        )

    return math.exp(minimize_scalar(loss, bounds=(-3, 3), method="bounded").x)


def count_scores(
    distance: NDArray[np.float32],
    chance: NDArray[np.float32] | None,
    true: NDArray[np.float32],
    unknown: NDArray[np.bool_],
    grid: GridSpec,
) -> NDArray[np.int64]:
    """How many of a map's `unknown` voxels have which score: (bins, steps), from minus the
    truncation up. The arrays have one shape: predicted distances, `corrected` probabilities where
    there are some, and true distances."""
    chances, last = (() if chance is None else CHANCES), _steps(grid) - 1
    count = distance_bins(grid, STEP_M)
    said = distance[unknown]
    into = bins(said, None if chance is None else chance[unknown], STEP_M, chances, count)
    score = np.ceil((said - true[unknown]) / SCORE_M - 1e-3).astype(np.int64) + last // 2
    flat = np.bincount(
        into * (last + 1) + np.clip(score, 0, last),
        minlength=count * (len(chances) + 1) * (last + 1),
    )
    return flat.reshape(-1, last + 1)


def fit_margins(
    counts: NDArray[np.int64], near: NDArray[np.bool_], risks: tuple[float, ...] = RISKS
) -> tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]:
    """Risks, and the margins for each (risks, bins), metres, from the scores (worlds, bins, steps)
    of `count_scores`, summed over the maps of a world. `near` (bins,) tells the bins of near
    voxels. Of `risks`, those remain that so many worlds can promise: at least 1 / (worlds + 1)."""
    kept = tuple(risk for risk in risks if (1 - risk) * (len(counts) + 1) <= len(counts) + 1e-9)
    summed = counts.cumsum(axis=2)
    fold = np.arange(len(counts)) % min(FOLDS, len(counts))
    groups = np.stack([np.ones_like(near), near, ~near]).astype(np.float64)  # (groups, bins)
    rows: list[NDArray[np.int64]] = []
    for risk in kept:
        shapes = np.stack(
            [shape(counts[fold != one].sum(axis=0), risk) for one in range(fold.max() + 1)]
        )
        added = _added(summed, shapes[fold], groups, risk)
        row = shape(counts.sum(axis=0), risk) + added
        rows.append(
            np.maximum(row, rows[-1]) if rows else row
        )  # a smaller risk never has a nearer bound
    middle = counts.shape[2] // 2
    found = [[round(SCORE_M * min(int(step) - middle, middle), 6) for step in row] for row in rows]
    return kept, tuple(map(tuple, found))


def shape(counts: NDArray[np.int64], risk: float) -> NDArray[np.int64]:
    """By bin, the least score (bins,), in steps, that a share 1 - `risk` of the scores (bins,
    steps) do not exceed; the greatest there is where a bin is empty."""
    summed, last = counts.cumsum(axis=1), counts.shape[1] - 1
    enough = summed >= (1 - risk) * summed[:, -1:]
    return np.where(summed[:, -1] > 0, enough.argmax(axis=1), last)


def _added(
    summed: NDArray[np.int64], shapes: NDArray[np.int64], groups: NDArray[np.float64], risk: float
) -> int:
    """The fewest steps which, added to each world's `shapes` (worlds, bins), cover enough of all
    `groups` (groups, bins); `summed` (worlds, bins, steps) are sums of scores up to each."""
    last = summed.shape[2] - 1
    voxels = summed[:, :, -1] @ groups.T  # (worlds, groups)
    worlds = (voxels > 0).sum(axis=0)
    needed = np.minimum((1 - risk) * (worlds + 1), worlds)
    for step in range(last + 1):
        at = np.minimum(shapes + step, last)
        covered = np.take_along_axis(summed, at[:, :, None], axis=2)[:, :, 0] @ groups.T
        shares = np.divide(covered, voxels, out=np.zeros_like(covered), where=voxels > 0)
        if (shares.sum(axis=0) >= needed - 1e-9).all():
            return step
    return last


def path_risks(collided: NDArray[np.float64]) -> tuple[float, ...]:
    """What share of paths collides at most, by risk of the bounds that they were planned on, from
    the shares (worlds, risks) of every world's trials in which one did; risks fall.

    Conformal risk control (Angelopoulos et al. 2024): a world's loss is the greatest at this risk
    or any smaller one, so that it is monotone; and a new world may lose all.
    """
    monotone = np.maximum.accumulate(collided[:, ::-1], axis=1)[:, ::-1]
    return tuple(((monotone.sum(axis=0) + 1) / (len(collided) + 1)).tolist())


def near_bins(grid: GridSpec, chances: tuple[float, ...]) -> NDArray[np.bool_]:
    """Which bins of the margins hold voxels that are predicted to be near an obstacle."""
    edges = np.arange(distance_bins(grid, STEP_M)) * STEP_M
    return np.repeat(edges < NEAR_M - 1e-9, len(chances) + 1)


def _steps(grid: GridSpec) -> int:
    return 2 * math.ceil(grid.truncation_m / SCORE_M) + 1


def _logits() -> NDArray[np.float64]:
    """The middles of the bins of logits."""
    return np.arange(-MOST_LOGIT + 0.5 * LOGIT, MOST_LOGIT, LOGIT)
