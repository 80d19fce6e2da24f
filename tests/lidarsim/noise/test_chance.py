"""Normal numbers: their distribution and their independence."""

import numpy as np
import pytest
from scipy import stats

from lidarsim.noise.returns import normal


@pytest.mark.parametrize("shape", [(50_000,), (3, 7001)])
def test_numbers_are_standard_normal_and_independent(shape):
    drawn = normal(shape, rng=np.random.default_rng(4))
    assert drawn.shape == shape
    flat = drawn.reshape(-1)
    assert stats.kstest(flat, "norm").pvalue > 0.01
    assert abs(flat.mean()) < 4 / np.sqrt(flat.size)
    half = flat.size // 2  # the two numbers of one pair stand half apart
    for one, other in ((flat[:half], flat[half : 2 * half]), (flat[:-1], flat[1:])):
        assert stats.pearsonr(one, other).pvalue > 0.01
        assert stats.pearsonr(one**2, other**2).pvalue > 0.01
