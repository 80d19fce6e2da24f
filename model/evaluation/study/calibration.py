"""Whether probabilities are what they say: of voxels said to be occupied with p, a share of p should be."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.jit import kernel
from scenegen.model.evaluation.statistics import interval

BINS = 20
"""Bins of probability, equally wide."""
REGIONS = ("map", "unobserved")
"""Voxels of the whole map, and the unknown ones among them."""
READINGS = ("said", "corrected")
"""The probability as it was said; and with the class weight of the loss inverted."""
COUNTS = ("voxels", "said", "occupied")
"""Sums over the voxels in a bin: how many, their probabilities, how many are occupied."""


def count(
    probability: NDArray[np.float32], occupancy: NDArray[np.bool_], unknown: NDArray[np.bool_], weight: float
) -> NDArray[np.float64]:
    """The counts of one map, (regions, readings, BINS, counts); the grids have one shape.

    A network trained with `weight` on occupied voxels, where a free one has 1, minimises its loss by saying
    w q / (w q + 1 - q) of a voxel that is occupied with probability q. Inverted: q = p / (p + w (1 - p)).
    """
    counts = np.zeros((len(REGIONS), len(READINGS), BINS, len(COUNTS)))
    _count(probability.reshape(-1), occupancy.reshape(-1), unknown.reshape(-1), weight, counts)
    return counts


@kernel
def _count(probability, occupancy, unknown, weight, counts):
    bins = counts.shape[2]
    for v in range(len(probability)):
        p = float(probability[v])
        for reading in range(2):
            q = p if reading == 0 else p / (p + weight * (1.0 - p))
            b = min(int(q * bins), bins - 1)
            for region in range(2 if unknown[v] else 1):
                counts[region, reading, b, 0] += 1.0
                counts[region, reading, b, 1] += q
                counts[region, reading, b, 2] += occupancy[v]


def reliability(counts: NDArray[np.float64], worlds: NDArray[np.int64], *, rng: np.random.Generator) -> dict[str, Any]:
    """The reliability of N maps of `worlds` (N,): by region and reading, the expected calibration error, which is the
    mean over voxels of |occupied - said| by bin, with its 95 % interval, and the bins that hold voxels.

    `counts` (N, regions, readings, BINS, counts) are those of `count`.
    """
    found: dict[str, Any] = {}
    for r, region in enumerate(REGIONS):
        for n, reading in enumerate(READINGS):
            maps = counts[:, r, n]
            total = maps.sum(axis=0)
            low, high = interval(maps.reshape(len(maps), -1), worlds, _ece, rng=rng)
            bins = [
                {
                    "from": b / BINS,
                    "to": (b + 1) / BINS,
                    "voxels": int(voxels),
                    "said": p / voxels,
                    "occupied": o / voxels,
                }
                for b, (voxels, p, o) in enumerate(total.tolist())
                if voxels
            ]
            ece = float(_ece(total.reshape(1, -1))[0])
            found.setdefault(region, {})[reading] = {"ece": ece, "low": low, "high": high, "bins": bins}
    return found


def _ece(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Expected calibration errors (k,) of sums (k, BINS * counts); NaN of no voxels."""
    voxels, said, occupied = np.moveaxis(sums.reshape(len(sums), BINS, len(COUNTS)), -1, 0)
    whole = voxels.sum(axis=1)
    return np.where(whole > 0, np.abs(said - occupied).sum(axis=1) / np.maximum(whole, 1), np.nan)
