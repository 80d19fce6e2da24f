"""Intervals cover, tests hold their level, and both go by worlds."""

import numpy as np
import pytest
from scipy import stats

from scenegen.model.evaluation.statistics import holm, paired_p, summarize


def test_mean_spread_and_count_are_those_of_the_samples() -> None:
    figure = summarize([1.0, 2.0, np.nan, 6.0], [0, 0, 1, 1], rng=np.random.default_rng(0))
    assert (figure.mean, figure.n) == (3.0, 3)
    assert figure.std == pytest.approx(np.std([1, 2, 6], ddof=1))
    assert figure.low <= 3.0 <= figure.high
    assert summarize([np.nan], [0], rng=np.random.default_rng(0)).n == 0
    alone = summarize([1.0, 2.0], [4, 4], rng=np.random.default_rng(0))
    assert (alone.mean, alone.low, alone.high) == (1.5, None, None), "one world says nothing of others"


@pytest.mark.slow
def test_intervals_cover_the_true_mean_where_samples_of_a_world_go_together() -> None:
    rng = np.random.default_rng(1)
    covered = naive = 0
    for _ in range(300):
        worlds = np.repeat(np.arange(40), 5)
        values = rng.normal(0, 1, 40)[worlds] + rng.normal(0, 0.2, 200)
        figure = summarize(values, worlds, rng=rng)
        covered += figure.low <= 0 <= figure.high
        alone = summarize(values, np.arange(200), rng=rng)
        naive += alone.low <= 0 <= alone.high
    assert 0.90 < covered / 300 < 0.99
    assert naive / 300 < 0.75, "taking samples for independent must fail, or this test shows nothing"


def test_the_paired_test_holds_its_level_and_finds_a_difference() -> None:
    rng = np.random.default_rng(2)
    worlds = np.repeat(np.arange(30), 4)
    equal, unequal = [], []
    for _ in range(200):
        shared = rng.normal(0, 3, 120)
        effect = rng.normal(0, 0.5, 30)[worlds]
        equal.append(paired_p(shared + effect, shared, worlds, rng=rng))
        unequal.append(paired_p(shared + effect + 0.5, shared, worlds, rng=rng))
    assert np.mean(np.array(equal) < 0.05) < 0.1
    assert np.mean(np.array(unequal) < 0.05) > 0.95
    assert paired_p(shared, shared, worlds, rng=rng) == 1.0


def test_holm_agrees_with_scipys_ordering_and_hand_computation() -> None:
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    p = np.random.default_rng(3).random(20)
    assert (holm(p) >= stats.false_discovery_control(p)).all()
    assert (holm(p) <= np.minimum(20 * p, 1)).all()
