"""The distributions are what they are called."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarsim.pose import rotate
from scenegen.recipes.kind import attitudes, normal


def distance(values, distribution):
    """Kolmogorov's, between the sample and its distribution function at the sorted sample, times
    the root of n."""
    n = len(values)
    steps = np.arange(n + 1) / n
    return float(
        math.sqrt(n) * max((steps[1:] - distribution).max(), (distribution - steps[:-1]).max())
    )


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_normal_numbers_are_normal_in_their_tails_too(rng):
    drawn = normal((40_000, 3), rng=rng)
    flat = np.sort(drawn.ravel())
    assert distance(flat, np.array([0.5 * math.erfc(-x / math.sqrt(2.0)) for x in flat])) < 1.8
    assert abs(np.count_nonzero(np.abs(flat) > 3.0) - 0.0026998 * flat.size) < 5 * math.sqrt(
        0.0027 * flat.size
    )
    assert np.abs(np.corrcoef(drawn.T) - np.eye(3)).max() < 0.03
    assert np.abs(np.corrcoef(np.abs(drawn).T) - np.eye(3)).max() < 0.03
    assert normal((7, 3), rng=rng).shape == (7, 3)
    assert normal((0, 3), rng=rng).shape == (0, 3)


def test_attitudes_are_uniform_or_upright(rng):
    drawn = attitudes(40_000, 1.0, rng=rng)
    assert_allclose((drawn * drawn).sum(axis=1), 1.0, rtol=0, atol=1e-14)
    # Archimedes: each coordinate of a turned unit vector is uniform
    axes = np.array([rotate(quaternion, np.eye(3)) for quaternion in drawn])
    for axis in range(3):
        for along in range(3):
            turned = np.sort(axes[:, axis, along])
            assert distance(turned, (turned + 1.0) / 2.0) < 1.95
    # the angle of the turn has density (1 - cos) / π, which turned axes alone do not show
    angle = np.sort(2.0 * np.arccos(np.minimum(np.abs(drawn[:, 0]), 1.0)))
    assert distance(angle, (angle - np.sin(angle)) / np.pi) < 1.8

    upright = attitudes(20_000, 0.0, rng=rng)
    assert_allclose((upright * upright).sum(axis=1), 1.0, rtol=0, atol=1e-14)
    assert (upright[:, 1:3] == 0.0).all()
    turned = np.sort(np.arctan2(upright[:, 3], upright[:, 0]))
    assert distance(turned, (turned + np.pi) / (2.0 * np.pi)) < 1.8
    share = np.count_nonzero(attitudes(20_000, 0.3, rng=rng)[:, 1]) / 20_000
    assert abs(share - 0.3) < 0.02
