"""Reliability against slow references, and how class weights are inverted."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scenegen.model.bench.reliability import BINS, REGIONS, count, regions, reliability
from scenegen.model.calibration import corrected

SHAPE = (40, 40, 40)


def drawn(weight, seed=0):
    """What a network says that minimises a loss with `weight`; what is occupied; what is
    unknown."""
    rng = np.random.default_rng(seed)
    chance = rng.random(SHAPE) ** 2
    occupied, unknown = rng.random(SHAPE) < chance, rng.random(SHAPE) < 0.3
    return (weight * chance / (weight * chance + 1 - chance)).astype(np.float32), occupied, unknown


def counted(said, occupied, unknown, weight):
    inside = np.zeros((len(REGIONS), *SHAPE), bool)
    inside[0], inside[1] = True, unknown
    return count([said, corrected(said, weight)], occupied, inside)


def test_counts_are_those_of_histograms():
    said, occupied, unknown = drawn(5.0)
    counts = counted(said, occupied, unknown, 5.0)
    for r, region in enumerate((np.ones(SHAPE, bool), unknown)):
        for n, q in enumerate((said.astype(float), said / (said + 5 * (1 - said.astype(float))))):
            for c, weights in enumerate((None, q[region], occupied[region].astype(float))):
                expected = np.histogram(q[region], BINS, (0, 1), weights=weights)[0]
                assert_allclose(counts[r, n, :, c], expected, atol=1e-6)
            q, o = q[region], occupied[region]
            nll, brier = (
                np.where(o, -np.log(q + 1e-30), -np.log1p(-q)).sum(),
                np.square(o - q).sum(),
            )
            assert_allclose(counts[r, n, :, 3:].sum(axis=0), (nll, brier), rtol=1e-3)
    assert not counts[2:].any()  # no voxel is in those regions
    assert not counts[:, 2].any()  # nobody gave that reading


@pytest.mark.parametrize("weight", [1.0, 5.0])
def test_inverting_the_weight_calibrates_what_was_trained_with_it(weight):
    counts = np.array([counted(*drawn(weight, seed), weight) for seed in range(4)])
    found = reliability(counts, np.array([0, 0, 1, 2]))
    for region in found.values():
        assert region["corrected"]["ece"] < 0.01
        said = region["said"]
        assert (said["ece"] > 0.1) == (weight == 5.0)
        assert said["low"] <= said["ece"] <= said["high"] + 1e-3


def test_certain_and_right_is_calibrated():
    occupied = drawn(1.0)[1]
    counts = counted(occupied.astype(np.float32), occupied, occupied, 5.0)
    found = reliability(counts[None], [0])
    assert found["map"]["corrected"]["ece"] == found["unobserved"]["said"]["ece"] == 0.0
    assert [one["occupied"] for one in found["map"]["said"]["bins"]] == [0.0, 1.0]


def test_regions_are_told_by_the_nearest_obstacle():
    unknown = np.arange(5) < 4
    true, seen = np.array([[0.4, 0.4, 1.5, 2.0, 0.4], [0.4, 1.0, 1.5, 2.0, 0.4]], np.float32)
    inside = regions(np.ones(5, bool), unknown, true, seen, truncation_m=2.0)
    masks = ["".join(map(str, row)) for row in inside.astype(int).tolist()]
    assert dict(zip(REGIONS, masks, strict=True)) == {
        "map": "11111",
        "unobserved": "11110",
        "seen": "10100",
        "unseen": "01000",
    }
