"""Near-twins are found among many maps, and all of them: a slow comparison of all with all says so."""

import numpy as np
import pytest

from scenegen.verify.twins import OCCUPIED_IOU, candidates, overlap, signature


@pytest.mark.parametrize("shape", [(24, 24, 16), (80, 80, 40), (7, 9, 3), (1, 1, 1)])
def test_a_signature_counts_every_voxel_once(shape: tuple[int, int, int]) -> None:
    occupancy = np.random.default_rng(0).random(shape) < 0.3
    blocks = signature(occupancy)
    assert blocks.shape == (320,)
    assert blocks.sum() == occupancy.sum()


def test_no_near_twin_is_missed() -> None:
    rng = np.random.default_rng(1)
    maps = [rng.random((16, 16, 10)) < rng.uniform(0.02, 0.5) for _ in range(60)]
    for n in range(20):  # half of these are near enough to be twins
        flipped = rng.random((16, 16, 10)) < rng.uniform(0.0, 0.1) * maps[n].mean()
        maps.append(maps[n] ^ flipped)
    splits = rng.integers(0, 3, len(maps))
    found, complete = candidates(np.array([signature(m) for m in maps]), splits)
    assert complete
    pairs = {frozenset(map(int, pair)) for pair in found}
    assert len(pairs) == len(found)
    expected = {
        frozenset((a, b))
        for a in range(len(maps))
        for b in range(a)
        if splits[a] != splits[b] and overlap(maps[a], maps[b]) >= OCCUPIED_IOU
    }
    assert len(expected) > 3
    assert expected <= pairs
    assert len(pairs) < 60  # of 2000 and more
    assert all(splits[a] != splits[b] for a, b in found)


def test_empty_maps_are_no_twins() -> None:
    empty = np.zeros((4, 320), np.uint32)
    found, complete = candidates(empty, np.array([0, 1, 2, 0]))
    assert (len(found), complete) == (0, True)
