"""Near-twins: samples of different splits that show next to the same map, found without comparing all with all."""

import math

import numpy as np
from numpy.typing import NDArray

from lidarsim.jit import kernel

OCCUPIED_IOU = 0.95
"""Maps are near-twins when their occupied voxels agree this far (intersection over union), and …"""
OBSERVED_IOU = 0.5
"""… their observed voxels this far. The truth alone would not do: over a flat floor with next to nothing on it, maps of
different worlds are the same; what rays hit of it, from another height at another heading, is not."""
MOST_PAIRS = 5_000
"""Candidates that are compared voxel by voxel, the likeliest first."""


def signature(occupancy: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Occupied voxels in each of 8 x 8 x 5 blocks of a map, flat (320,)."""
    blocks = np.zeros(320, dtype=np.uint32)
    _count(occupancy.view(np.uint8), blocks)
    return blocks


@kernel
def _count(occupied, blocks):
    nx, ny, nz = occupied.shape
    a, b, c = -(-nx // 8), -(-ny // 8), -(-nz // 5)
    for i in range(nx):
        for j in range(ny):
            row = ((i // a) * 8 + j // b) * 5
            for block in range(-(-nz // c)):
                total = np.uint32(0)
                for value in occupied[i, j, block * c : min((block + 1) * c, nz)]:
                    total += value
                blocks[row + block] += total


def candidates(signatures: NDArray[np.uint32], splits: NDArray[np.int64]) -> tuple[NDArray[np.int64], bool]:
    """Pairs (P, 2) of samples of different splits that may be near-twins, the likeliest first, and whether these are
    all. No near-twin is missed as long as they are.

    Voxels in which two maps differ are at least as many as the sum of the differences of their blocks, so most pairs
    are ruled out by a few numbers; sorted by how much is occupied, only neighbours are looked at.
    """
    counts = signatures.sum(axis=1, dtype=np.int64)
    order = np.argsort(counts, kind="stable")
    coarse = signatures.reshape(-1, 2, 4, 2, 4, 5).sum(axis=(2, 4), dtype=np.int64).reshape(-1, 20)
    limit = 20 * MOST_PAIRS
    pairs, gaps = np.empty((limit, 2), np.int64), np.empty(limit, np.int64)
    found = _pairs(
        counts[order],
        splits[order],
        coarse[order].astype(np.int32),
        signatures[order].astype(np.int32),
        1.0 - OCCUPIED_IOU,
        pairs,
        gaps,
    )
    kept = min(found, limit)
    ranked = np.argsort(gaps[:kept], kind="stable")[:MOST_PAIRS]
    return order[pairs[:kept][ranked]], found <= MOST_PAIRS


@kernel
def _pairs(counts, splits, coarse, fine, share, pairs, gaps):
    """Fill `pairs` with candidates, as many as fit, and return how many there are."""
    found = 0
    for i in range(len(counts)):
        if counts[i] == 0:
            continue  # an empty map has no twin
        for j in range(i + 1, len(counts)):
            if counts[i] < (1.0 - share) * counts[j]:
                break
            if splits[i] == splits[j]:
                continue
            # with d voxels that differ and s = |A| + |B|, the union is (s + d) / 2, so IoU >= 1 - share means this
            most = math.floor(share * (counts[i] + counts[j]) / (2.0 - share) + 1e-9)
            if _beyond(coarse[i], coarse[j], most) > most:
                continue
            gap = _beyond(fine[i], fine[j], most)
            if gap > most:
                continue
            if found < len(pairs):
                pairs[found, 0], pairs[found, 1] = i, j
                gaps[found] = gap
            found += 1
            if found > 4 * len(pairs):
                return found  # a folder full of twins: no need to count them all
    return found


@kernel
def _beyond(a, b, most):
    """Sum of absolute differences, or, as soon as that is certain, something above `most`."""
    total = 0
    for begin in range(0, len(a), 20):
        for n in range(begin, begin + 20):
            total += abs(a[n] - b[n])
        if total > most:
            break
    return total


def overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union; 0 where both are empty."""
    return float(np.count_nonzero(a & b)) / max(float(np.count_nonzero(a | b)), 1.0)
