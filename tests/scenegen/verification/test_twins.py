"""Near-twins are found among many maps, and all of them: a slow comparison of all with all says
so."""

import itertools

import numpy as np
import pytest

from scenegen.verification.splits import (
    OBSERVED_IOU,
    OCCUPIED_IOU,
    candidates,
    overlap,
    signature,
    standing_overlap,
)


def test_no_near_twin_is_missed(rng):
    def flipped(mask, highest):
        """Each voxel with a chance up to `highest` of the mask's share."""
        return mask ^ (rng.random(mask.shape) < rng.uniform(0.0, highest) * mask.mean())

    shape = (16, 16, 10)
    maps = [rng.random(shape) < rng.uniform(0.02, 0.5) for _ in range(60)]
    seen = [mask & (rng.random(shape) < 0.3) for mask in maps]
    # some of these are near enough to be twins, some only in one of the two ways
    maps += [flipped(mask, 0.08) for mask in maps[:40]]
    seen += [flipped(mask, 1.2) for mask in seen[:40]]
    splits = rng.integers(0, 3, len(maps))
    signatures = (np.array([*map(signature, masks)]) for masks in (maps, seen))
    found, complete = candidates(*signatures, splits)
    pairs = {tuple(sorted(map(int, pair))) for pair in found}
    assert len(pairs) == len(found)
    assert complete
    different = {
        (a, b) for a, b in itertools.combinations(range(len(maps)), 2) if splits[a] != splits[b]
    }
    occupied = [(a, b) for a, b in different if overlap(maps[a], maps[b]) >= OCCUPIED_IOU]
    expected = {(a, b) for a, b in occupied if overlap(seen[a], seen[b]) >= OBSERVED_IOU}
    assert 5 < len(expected) < len(occupied)
    assert expected <= pairs <= different
    assert len(pairs) < 4 * len(expected)  # of 3000 and more


def test_a_floor_alone_makes_no_twins():
    floor = np.zeros((20, 20, 10), bool)
    floor[:, :, :4] = True
    left, right = floor.copy(), floor.copy()
    left[3:6, 3:6, 4:8] = right[12:15, 9:13, 4:8] = True
    assert overlap(left, right) > OCCUPIED_IOU
    assert standing_overlap(left, right) == 0.0
    assert standing_overlap(left, left) == standing_overlap(floor, floor) == 1.0
    right = left.copy()
    right[:, :, 3] = False  # no floor in one of the two: it stands for itself
    assert standing_overlap(left, right) < 0.1


@pytest.mark.parametrize(("value", "count", "pairs"), [(0, 4, 0), (1, 600, 5000)])
def test_equal_maps_are_no_twins_if_empty_and_else_not_all_compared(value, count, pairs):
    same = np.full((count, 320), value, np.int32)
    found, complete = candidates(same, same, np.arange(count) % 3)
    assert len(found) == pairs
    assert complete == (not value)
