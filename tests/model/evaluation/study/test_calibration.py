"""Reliability against numpy's histograms, and the law by which the class weight is inverted."""

import numpy as np
import pytest

from scenegen.model.evaluation.study.calibration import BINS, count, reliability

SHAPE = (40, 40, 40)


def drawn(weight: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a network says that minimises a loss with `weight`; what is occupied; what is unknown."""
    rng = np.random.default_rng(seed)
    chance = rng.random(SHAPE) ** 2
    occupied, unknown = rng.random(SHAPE) < chance, rng.random(SHAPE) < 0.3
    return (weight * chance / (weight * chance + 1 - chance)).astype(np.float32), occupied, unknown


def test_counts_are_those_of_histograms() -> None:
    said, occupied, unknown = drawn(5.0)
    counts = count(said, occupied, unknown, 5.0)
    for r, region in enumerate((np.ones(SHAPE, bool), unknown)):
        for n, q in enumerate((said.astype(float), said / (said + 5 * (1 - said.astype(float))))):
            for c, weights in enumerate((None, q[region], occupied[region].astype(float))):
                expected = np.histogram(q[region], BINS, (0, 1), weights=weights)[0]
                np.testing.assert_allclose(counts[r, n, :, c], expected, atol=1e-6)


@pytest.mark.parametrize("weight", [1.0, 5.0])
def test_inverting_the_weight_calibrates_what_was_trained_with_it(weight: float) -> None:
    counts = np.array([count(*drawn(weight, seed), weight) for seed in range(4)])
    found = reliability(counts, np.array([0, 0, 1, 2]), rng=np.random.default_rng(0))
    for region in found.values():
        assert region["corrected"]["ece"] < 0.01
        assert (region["said"]["ece"] > 0.1) == (weight == 5.0)
        assert region["said"]["low"] <= region["said"]["ece"] <= region["said"]["high"] + 1e-3
    alone = reliability(counts, np.zeros(4, int), rng=np.random.default_rng(0))
    assert (alone["map"]["said"]["low"], alone["map"]["said"]["high"]) == (None, None)


def test_certain_and_right_is_calibrated() -> None:
    occupied = drawn(1.0)[1]
    counts = count(occupied.astype(np.float32), occupied, occupied, 5.0)
    found = reliability(counts[None], np.zeros(1, int), rng=np.random.default_rng(0))
    assert found["map"]["corrected"]["ece"] == found["unobserved"]["said"]["ece"] == 0.0
    assert [one["occupied"] for one in found["map"]["said"]["bins"]] == [0.0, 1.0]
