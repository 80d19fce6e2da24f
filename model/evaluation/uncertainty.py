"""Whether probabilities and bounds of distance are what they say."""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np

from lidarsim.grid import Field, Floats, Ints, Mask
from lidarsim.jit import kernel
from scenegen.files import Json
from scenegen.model.calibration import RISK
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import NEAR_M
from scenegen.model.evaluation.statistics import estimate, summarise

BINS = 20
"""Bins of probability, equally wide."""
REGIONS = ("map", "unobserved", "near", "said_near", "seen", "unseen")
"""Voxels of the whole map; the unknown ones among them; and of these, those near an obstacle, those
predicted to be, those whose nearest obstacle returned something, and those whose nearest obstacle
within the truncation did not."""
READINGS = ("said", "corrected", "calibrated")
"""The probability as it was said; with the class weight of the loss inverted; and as the method's
calibration has it, where there is one."""
COUNTS = ("voxels", "said", "occupied", "nll", "brier")
"""Sums over the voxels in a bin: how many, their probabilities, how many are occupied; the negative
logarithms of what was said of that which is, and the squared errors."""
SMALLEST = 1e-7
"""What a probability of 0 counts as where its logarithm is taken."""


def regions(
    scored: Mask,
    unknown: Mask,
    distance: Field,
    true: Field,
    seen: Field,
    *,
    truncation_m: float,
) -> Mask:
    """The voxels of each of `REGIONS`, (regions, *shape): none that is not `scored`, and otherwise
    from predicted and true distances and those to the obstacles that returned something; the grids
    have one shape."""
    met = unknown & (true < truncation_m - 1e-6)
    parts = (unknown & (true <= NEAR_M), unknown & (distance < NEAR_M), met & (seen <= true))
    return np.stack([scored, unknown, *parts, met & (seen > true)])


def count(
    readings: Sequence[Field],
    occupancy: Mask,
    inside: Mask,
) -> Floats:
    """The counts of one map, (regions, READINGS, BINS, COUNTS), from the probabilities of the first
    so many `READINGS`; the grids have one shape, and `inside` tells the `regions`."""
    counts = np.zeros((len(REGIONS), len(READINGS), BINS, len(COUNTS)))
    for n, said in enumerate(readings):
        masks = inside.reshape(len(inside), -1)
        _count(said.reshape(-1), occupancy.reshape(-1), masks, counts[:, n])
    return counts


@kernel
def _count(probability, occupancy, inside, counts):
    parts, bins, _ = counts.shape
    for v in range(len(probability)):
        q = float(probability[v])
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
    """The reliability of N maps of `worlds` (N,): by region and reading, the bins that hold voxels;
    and over all voxels
    the negative log-likelihood, the Brier score, and the expected calibration error, which is the
    mean of
    |occupied - said| by bin, with 95 % intervals. Readings that nobody gave, and regions without
    voxels, are left out.

    `counts` (N, regions, readings, BINS, counts) are those of `count`.
    """
    found: Json = {}
    for r, region in enumerate(REGIONS):
        for n, reading in enumerate(READINGS):
            maps = counts[:, r, n]
            total = maps.sum(axis=0)
            if not total[:, 0].any():
                continue
            figures = {}
            for name in SCORES:
                one = estimate(maps.reshape(len(maps), -1), worlds, partial(_score, name))
                low, high = one.ends
                figures[name] = {"mean": one.value, "low": low, "high": high}
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
            found.setdefault(region, {})[reading] = {
                "ece": ece.pop("mean"),
                **ece,
                **figures,
                "bins": bins,
            }
    return found


def _score(name: str, sums: Floats) -> Floats:
    """One of `SCORES` (k,) of sums (k, BINS * counts): expected calibration errors, or means over
    voxels; NaN of no voxels."""
    counts = sums.reshape(len(sums), BINS, len(COUNTS))
    voxels, said, occupied = np.moveaxis(counts, -1, 0)[:3]
    wrong = np.abs(said - occupied) if name == "ece" else counts[:, :, COUNTS.index(name)]
    whole = voxels.sum(axis=1)
    return np.where(whole > 0, wrong.sum(axis=1) / np.maximum(whole, 1), np.nan)


SCORES = ("ece", "nll", "brier")
"""What probabilities are judged by."""
PARTS = REGIONS[1:]
"""Regions that bounds are judged over: those of unknown voxels."""
JUDGED = ("coverage", "width")
"""The share of voxels whose true distance is the bound or more; and predicted distance less bound,
metres."""
SHARES = np.arange(1, 21) / 20
"""Shares of voxels, the surest first, at which sparsification is looked at."""


def judge_bounds(
    said: Prediction,
    distance: Field,
    true: Field,
    inside: Mask,
    truncation_m: float,
) -> tuple[Floats, float]:
    """By risk, region of `inside` and figure, (risks, PARTS, JUDGED), what the bounds of a
    prediction whose distances are `distance` are worth on one map; and its area under the
    sparsification error, of the bounds nearest to `RISK`. NaN over no voxels, and without bounds.
    True and predicted distances are cut at the truncation, and so are bounds: one beyond it says
    as much as one at it."""
    risks = () if said.uncertainty is None else said.uncertainty.risks
    found = np.full((len(risks), len(PARTS), len(JUDGED)), np.nan)
    unknown, sparse = inside[1], np.nan
    usual = min(risks, key=lambda risk: abs(risk - RISK), default=None)
    for n, risk in enumerate(risks):
        low = np.minimum(said.low(risk), np.float32(truncation_m))
        covers, width = true >= low - 1e-4, distance - low
        for p, part in enumerate(inside[1:]):
            if part.any():
                found[n, p] = covers[part].mean(), width[part].mean()
        if risk == usual and unknown.any():
            sparse = ause(np.abs(distance - true)[unknown], width[unknown])
    return found, sparse


def ause(error: Field, doubt: Field) -> float:
    """The area under the sparsification error (Ilg et al. 2018): by how much the mean `error` (n,)
    of the surest voxels by `doubt` (n,) exceeds that of the voxels with the least errors, over all
    shares of voxels, in mean errors. 0 where doubt orders voxels as errors do; voxels of equal
    doubt are as good as their mean."""
    mean = float(error.mean())
    if mean == 0:
        return 0.0
    # what rounding alone tells apart is equal
    _, group = np.unique(np.round(doubt, 5), return_inverse=True)
    levelled = (np.bincount(group, weights=error) / np.bincount(group))[group]
    at = np.maximum((SHARES * len(error)).astype(int), 1)
    first = [
        np.cumsum(one)[at - 1] / at
        for one in (levelled[np.argsort(group, kind="stable")], np.sort(error))
    ]
    return float((first[0] - first[1]).mean()) / mean


def bounds_of(
    judged: Floats,
    sparse: Floats,
    risks: tuple[float, ...],
    worlds: Ints,
) -> Json:
    """The report of N maps' bounds, from (N, risks, PARTS, JUDGED) and (N,): ``ause``, and a row a
    risk."""
    rows = [
        {"risk": risk}
        | {
            part: {name: summarise(judged[:, r, p, j], worlds) for j, name in enumerate(JUDGED)}
            for p, part in enumerate(PARTS)
        }
        for r, risk in enumerate(risks)
    ]
    return {"ause": summarise(sparse, worlds), "risks": rows}
