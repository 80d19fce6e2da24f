"""The distributions are what they are called."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from scenegen.worlds.kinds.kind import attitudes, normal
from tests.scenegen.kinds import looks_like_share, looks_uniform


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_normal_numbers_are_normal_in_their_tails_too(rng):
    drawn = normal((40_000, 3), rng=rng)
    assert stats.kstest(drawn.ravel(), stats.norm.cdf).pvalue > 1e-3
    tails = np.count_nonzero(np.abs(drawn) > 3.0)
    assert looks_like_share(tails, drawn.size, 2 * stats.norm.sf(3.0))
    assert np.abs(np.corrcoef(drawn.T) - np.eye(3)).max() < 0.03
    assert np.abs(np.corrcoef(np.abs(drawn).T) - np.eye(3)).max() < 0.03
    assert normal((7, 3), rng=rng).shape == (7, 3)
    assert normal((0, 3), rng=rng).shape == (0, 3)


def test_attitudes_are_uniform_or_upright(rng):
    drawn = attitudes(40_000, 1.0, rng=rng)
    assert_allclose((drawn * drawn).sum(axis=1), 1.0, rtol=0, atol=1e-14)
    # uniform is what has this law along every line (Cramér and Wold)
    for line in rng.normal(size=(20, 4)):
        along = drawn @ line / np.linalg.norm(line)
        assert stats.kstest(along, on_the_sphere).pvalue > 1e-3

    upright = attitudes(20_000, 0.0, rng=rng)
    assert_allclose((upright * upright).sum(axis=1), 1.0, rtol=0, atol=1e-14)
    assert (upright[:, 1:3] == 0.0).all()
    assert looks_uniform(np.arctan2(upright[:, 3], upright[:, 0]), -np.pi, np.pi)
    tilted = np.count_nonzero(attitudes(20_000, 0.3, rng=rng)[:, 1])
    assert looks_like_share(tilted, 20_000, 0.3)


def on_the_sphere(along):
    """The distribution along a line of points drawn evenly over the sphere in four dimensions."""
    return 0.5 + (along * np.sqrt(1.0 - along * along) + np.arcsin(along)) / np.pi
