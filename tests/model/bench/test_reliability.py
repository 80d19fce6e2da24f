"""Reliability against slow references, and how class weights are inverted."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scenegen.model.bench.reliability import BINS, REGIONS, count, regions, reliability
from scenegen.model.calibration import corrected
from tests.scenegen import cases

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
    exact = said.astype(float)
    for region, mask in enumerate((np.ones(SHAPE, bool), unknown)):
        for reading, chance in enumerate((exact, exact / (exact + 5 * (1 - exact)))):
            q, o = chance[mask], occupied[mask]
            for column, weights in enumerate((None, q, o.astype(float))):
                expected = np.histogram(q, BINS, (0, 1), weights=weights)[0]
                assert_allclose(counts[region, reading, :, column], expected, atol=1e-6)
            scores = np.where(o, -np.log(q + 1e-30), -np.log1p(-q)).sum(), np.square(o - q).sum()
            assert_allclose(counts[region, reading, :, 3:].sum(axis=0), scores, rtol=1e-3)
    assert not counts[2:].any()  # no voxel is in those regions
    assert not counts[:, 2].any()  # nobody gave that reading


@pytest.mark.parametrize("weight", [1.0, 5.0])
def test_inverting_the_weight_calibrates(weight):
    counts = np.array([counted(*drawn(weight, seed), weight) for seed in range(4)])
    for region in reliability(counts, np.array([0, 0, 1, 2])).values():
        assert region["corrected"]["ece"] < 0.01
        said = region["said"]
        assert (said["ece"] > 0.1) == (weight == 5.0)
        assert said["low"] <= said["ece"] <= said["high"] + 1e-3


def test_regions_go_by_the_nearest_obstacle():
    unknown = np.arange(5) < 4
    true, seen = np.array([[0.4, 0.4, 1.5, 2.0, 0.4], [0.4, 1.0, 1.5, 2.0, 0.4]], np.float32)
    inside = regions(np.ones(5, bool), unknown, true, seen, truncation_m=2.0)
    names, expected = zip(*cases("../model/regions"), strict=True)
    assert names == tuple(REGIONS)
    assert_array_equal(inside, np.loadtxt(expected))
