"""Intervals cover, tests hold their level, and both go by worlds."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from benchmarks.intervals import POPULATIONS, SPARSE, WORLDS, coverage
from scenegen.model.bench import statistics
from scenegen.model.bench.statistics import estimate, holm, paired_p, summarise


def test_summaries_are_those_of_the_samples():
    spread = summarise([1.0, 2.0, np.nan, 6.0], [0, 0, 1, 1])
    assert spread["mean"] == 3.0
    assert spread["n"] == 3
    assert spread["std"] == pytest.approx(np.std([1, 2, 6], ddof=1))
    assert summarise([np.nan], [0])["n"] == 0
    assert summarise([1.0, 2.0], [4, 4])["high"] is None  # one world says nothing of others
    assert list(summarise([1.0], [4]).values()) == [1.0, None, None, None, 1]


def test_intervals_of_equal_worlds_are_students(rng):
    """Of the worlds' means, where all worlds have as many samples."""
    values, worlds = rng.normal(3, 1, (7, 4)), np.repeat(np.arange(7), 4)
    means = values.mean(axis=1)
    expected = stats.t.interval(0.95, 6, means.mean(), stats.sem(means))
    summary = summarise(values.ravel(), worlds)
    assert (summary["low"], summary["high"]) == pytest.approx(expected)
    sums = np.stack([values.ravel(), np.ones(28)], axis=1)
    of_mean = estimate(sums, worlds, lambda sums: sums[:, 0] / sums[:, 1])
    assert of_mean.ends == pytest.approx(expected)
    assert of_mean.chance == pytest.approx(stats.ttest_1samp(means, 0).pvalue)


@pytest.mark.parametrize("worlds", WORLDS)
def test_intervals_cover_the_mean_of_worlds_that_differ(worlds):
    """95 % within 2, and each population within what 500 draws leave open;
    `benchmarks/intervals.py` draws more. Where three to five trials a world decide, chance comes in
    steps, and intervals are on the safe side."""
    held = [coverage(population, worlds, 500) for population in POPULATIONS]
    assert 0.93 <= np.mean(held) <= 0.97
    assert min(held) >= 0.92
    assert max(held) <= 0.985
    assert min(coverage(population, worlds, 500) for population in SPARSE) >= 0.91


def test_outcomes_that_are_all_alike_are_not_certain():
    worlds = np.repeat(np.arange(3), 20)
    sure = summarise(np.ones(60), worlds, "outcome")
    assert 0.9 < sure["low"] < 0.98
    assert sure["high"] == 1
    equal = summarise(np.zeros(60), worlds, "gain")
    assert equal["low"] == -equal["high"] < 0
    exact = summarise(np.ones(60), worlds, "share")  # the truth's IoU, which chance has no part in
    assert exact["low"] == 1
    assert exact["high"] == 1


def test_the_paired_test_holds_its_level_and_finds_a_difference(monkeypatch, rng):
    monkeypatch.setattr(statistics, "FLIPS", 2000)
    worlds = np.repeat(np.arange(30), 4)
    chances = {0.0: [], 0.5: []}
    for effect in [*chances] * 200:
        shared = rng.normal(0, 3, 120)
        other = shared + effect + rng.normal(0, 0.5, 30)[worlds]
        chances[effect].append(paired_p(other, shared, worlds, rng=rng))
    assert np.less(chances[0.0], 0.05).mean() < 0.1
    assert np.less(chances[0.5], 0.05).mean() > 0.95
    assert paired_p(shared, shared, worlds, rng=rng) == 1.0


def test_holm_agrees_with_hand_computation():
    assert_allclose(holm([0.01, 0.04, 0.03, 0.9]), [0.04, 0.09, 0.09, 0.9])
    assert_allclose(holm([0.7, 0.6]), [1, 1])
