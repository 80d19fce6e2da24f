"""Laws of the elementary functions: nearest to the true values, to which Python's decimal numbers
are the reference."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim.elementary import exp, log, sin_cos

PI = Decimal(
    "3.1415926535897932384626433832795028841971693993751"
    "0582097494459230781640628620899862803482534211706798"
)
RNG = np.random.default_rng(0)
ANGLES = np.concatenate(
    [
        RNG.uniform(-7.0, 7.0, 200),
        np.radians(np.arange(-360.0, 361.0, 15.0)),
        RNG.uniform(-1e9, 1e9, 100),
        [1e-300, 5e-8],
    ]
)
EXPONENTS = np.concatenate(
    [RNG.uniform(-700.0, 709.0, 300), RNG.uniform(-1.0, 1.0, 100), [-1e-20, 0.0, 1e-300]]
)
NUMBERS = np.concatenate(
    [10.0 ** RNG.uniform(-307, 308, 300), RNG.uniform(0.5, 2.0, 300), [5e-324, 1e-310]]
)


def sine(angle):
    """By the power series, after whole turns are taken off."""
    angle = angle.remainder_near(2 * PI)
    total, term, n = Decimal(0), angle, 1
    while term and abs(term) > Decimal("1e-60") * abs(total):
        total += term
        term *= -angle * angle / ((n + 1) * (n + 2))
        n += 2
    return total


def off(values, references):
    """The greatest distance from the truth in units of the last place."""
    return max(
        float(abs(Decimal(float(value)) - truth) / Decimal(math.ulp(float(value))))
        for value, truth in zip(values, references, strict=True)
    )


@pytest.fixture(autouse=True)
def _digits():
    with localcontext(prec=90):
        yield


def test_sines_and_cosines_are_the_nearest_numbers():
    sines, cosines = sin_cos(ANGLES)
    assert off(sines, [sine(Decimal(float(x))) for x in ANGLES]) <= 0.5 + 1e-6
    assert off(cosines, [sine(PI / 2 - Decimal(float(x))) for x in ANGLES]) <= 0.5 + 1e-6


def test_exponentials_and_logarithms_are_the_nearest_numbers():
    assert off(exp(EXPONENTS), [Decimal(float(x)).exp() for x in EXPONENTS]) <= 0.5 + 1e-6
    assert off(log(NUMBERS), [Decimal(float(x)).ln() for x in NUMBERS]) <= 0.5 + 1e-6


def test_exact_values_and_limits():
    assert [float(part) for part in sin_cos(0.0)] == [0.0, 1.0]
    assert (float(exp(0.0)), float(log(1.0))) == (1.0, 0.0)
    assert_array_equal(
        exp([-np.inf, np.inf, np.nan, 800.0, -800.0]), [0.0, np.inf, np.nan, np.inf, 0.0]
    )
    assert_array_equal(log([0.0, np.inf, -1.0, np.nan]), [-np.inf, np.inf, np.nan, np.nan])
    assert_array_equal(sin_cos([np.inf, -np.inf, np.nan]), np.full((2, 3), np.nan))


def test_any_shape_and_layout_is_taken():
    x = RNG.uniform(-5.0, 5.0, (3, 4, 5)).transpose(2, 0, 1)[::2]
    for found in (*sin_cos(x), exp(x)):
        assert found.shape == x.shape
    assert_array_equal(sin_cos(x)[0][1, 2, 3], sin_cos(float(x[1, 2, 3]))[0])
    assert log(np.ones((0, 2))).shape == (0, 2)
