"""Normal numbers and directions: their distribution, their independence, and their bits."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.special import ndtr

from lidarsim.noise.returns import normal, on_circle

COUNT = 2_000_000
LEVEL = 1e-3
"""A true hypothesis fails so often; seeds are fixed."""


@pytest.fixture(scope="module")
def drawn():
    return normal((COUNT,), rng=np.random.default_rng(4))


def test_numbers_are_standard_normal(drawn):
    shares = ndtr(drawn)
    assert stats.kstest(shares, "uniform").pvalue > LEVEL
    for moment, (true, deviation) in enumerate([(0, 1), (1, 2), (0, 15), (3, 96)], start=1):
        assert abs((drawn**moment).mean() - true) < 4 * np.sqrt(deviation / COUNT)
    # as often in each of a thousand parts of equal probability, many within one layer
    often = np.bincount((shares * 1000).astype(int), minlength=1000)
    assert stats.chisquare(often).pvalue > LEVEL


@pytest.mark.parametrize("beyond", [3.0, 3.6, 3.654152885361009, 3.7, 4.0, 4.5, 5.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_tails_are_as_heavy_as_they_should(drawn, beyond, side):
    count = int((side * drawn > beyond).sum())
    assert stats.binomtest(count, COUNT, float(stats.norm.sf(beyond))).pvalue > LEVEL


@pytest.mark.parametrize("apart", [1, 2, 7, 1024, COUNT // 2])
def test_numbers_do_not_depend_on_each_other(drawn, apart):
    for change in (np.asarray, np.square, np.sign):
        changed = change(drawn)
        assert stats.pearsonr(changed[:-apart], changed[apart:]).pvalue > LEVEL


def test_directions_are_even_around_the_circle():
    cosine, sine = on_circle((200_000, 1), rng=np.random.default_rng(2))
    assert cosine.shape == sine.shape == (200_000, 1)
    assert_allclose(cosine**2 + sine**2, 1.0, rtol=1e-15)
    turned = np.arctan2(sine, cosine)[:, 0] / (2 * np.pi) + 0.5
    assert stats.kstest(turned, "uniform").pvalue > LEVEL
    assert stats.pearsonr(turned[1:], turned[:-1]).pvalue > LEVEL
