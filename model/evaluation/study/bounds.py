"""Bounds of distance judged: how often the truth keeps to them, and what they cost."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenegen.model.completion.protocol import Prediction
from scenegen.model.evaluation.statistics import figure
from scenegen.model.evaluation.study.calibration import REGIONS
from scenegen.model.uncertainty.calibration import RISK

PARTS = REGIONS[1:]
"""Regions that bounds are judged over: those of unknown voxels."""
JUDGED = ("coverage", "width")
"""The share of voxels whose true distance is the bound or more; and predicted distance less bound,
metres."""
SHARES = np.arange(1, 21) / 20
"""Shares of voxels, the surest first, at which sparsification is looked at."""


def judge_bounds(
    said: Prediction,
    distance: NDArray[np.float32],
    true: NDArray[np.float32],
    bits: NDArray[np.uint8],
) -> tuple[NDArray[np.float64], float]:
    """By risk, region and figure, (risks, PARTS, JUDGED), what the bounds of a prediction whose
    distances are `distance` are worth on one map; and its area under the sparsification error, of
    the bounds nearest to `RISK`. NaN over no voxels."""
    assert said.uncertainty is not None
    risks, inside = (
        said.uncertainty.risks,
        [(bits >> REGIONS.index(part) & 1).astype(bool) for part in PARTS],
    )
    found = np.full((len(risks), len(PARTS), len(JUDGED)), np.nan)
    sparse = np.nan
    usual = int(np.argmin([abs(risk - RISK) for risk in risks]))
    for n, risk in enumerate(risks):
        low = said.low(risk)
        for p, part in enumerate(inside):
            if part.any():
                found[n, p] = (
                    (true[part] >= low[part] - 1e-4).mean(),
                    (distance[part] - low[part]).mean(),
                )
        if n == usual and inside[0].any():
            sparse = ause(np.abs(distance - true)[inside[0]], (distance - low)[inside[0]])
    return found, sparse


def ause(error: NDArray[np.floating], doubt: NDArray[np.floating]) -> float:
    """The area under the sparsification error (Ilg et al. 2018): by how much the mean `error` (n,)
    of the surest voxels by `doubt` (n,) exceeds that of the voxels with the least errors, over all
    shares of voxels, in mean errors. 0 where doubt orders voxels as errors do; voxels of equal
    doubt are as good as their mean."""
    mean = float(error.mean())
    if mean == 0:
        return 0.0
    _, group = np.unique(doubt, return_inverse=True)
    levelled = (np.bincount(group, weights=error) / np.bincount(group))[group]
    at = np.maximum((SHARES * len(error)).astype(int), 1)
    first = [
        np.cumsum(one)[at - 1] / at
        for one in (levelled[np.argsort(group, kind="stable")], np.sort(error))
    ]
    return float((first[0] - first[1]).mean()) / mean


def bounds_of(
    judged: NDArray[np.float64],
    sparse: NDArray[np.float64],
    risks: tuple[float, ...],
    worlds: NDArray[np.int64],
) -> dict[str, Any]:
    """The report of N maps' bounds, from (N, risks, PARTS, JUDGED) and (N,): ``ause``, and a row a
    risk."""
    rows = [
        {"risk": risk}
        | {
            part: {name: figure(judged[:, r, p, j], worlds) for j, name in enumerate(JUDGED)}
            for p, part in enumerate(PARTS)
        }
        for r, risk in enumerate(risks)
    ]
    return {"ause": figure(sparse, worlds), "risks": rows}
