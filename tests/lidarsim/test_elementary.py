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
    [RNG.uniform(-7, 7, 200), np.radians(np.arange(-360, 361, 15)), RNG.uniform(-1e9, 1e9, 100)]
)
EXPONENTS = np.concatenate([RNG.uniform(-700, 709, 300), RNG.uniform(-1, 1, 100), [-1e-20]])
NUMBERS = np.concatenate([10 ** RNG.uniform(-307, 308, 300), RNG.uniform(0.5, 2, 300), [5e-324]])


def sin(x):
    return sin_cos(x)[0]


def cos(x):
    return sin_cos(x)[1]


def sine(angle):
    """By the power series, after whole turns are taken off."""
    angle = angle.remainder_near(2 * PI)
    total, term, n = Decimal(0), angle, 1
    while term and abs(term) > Decimal("1e-60") * abs(total):
        total += term
        term *= -angle * angle / ((n + 1) * (n + 2))
        n += 2
    return total


@pytest.mark.parametrize(
    ("function", "numbers", "truth"),
    [
        (sin, ANGLES, sine),
        (cos, ANGLES, lambda x: sine(PI / 2 - x)),
        (exp, EXPONENTS, Decimal.exp),
        (log, NUMBERS, Decimal.ln),
    ],
)
def test_values_are_the_nearest_numbers(function, numbers, truth):
    """Within half a unit of the last place."""
    with localcontext(prec=90):
        for value, x in zip(function(numbers).tolist(), numbers.tolist(), strict=True):
            away = abs(Decimal(value) - truth(Decimal(x))) / Decimal(math.ulp(value))
            assert away <= 0.5 + 1e-6


def test_exact_values_and_limits():
    inf, nan = np.inf, np.nan
    assert_array_equal(exp([0.0, -inf, inf, nan, 800.0, -800.0]), [1.0, 0.0, inf, nan, inf, 0.0])
    assert_array_equal(log([1.0, 0.0, inf, -1.0, nan]), [0.0, -inf, inf, nan, nan])
    assert_array_equal(sin_cos([0.0, inf, -inf, nan]), [[0.0, nan, nan, nan], [1.0, nan, nan, nan]])


def test_any_shape_and_layout_is_taken():
    x = RNG.uniform(-5.0, 5.0, (3, 4, 5)).transpose(2, 0, 1)[::2]
    for function in (sin, cos, exp):
        expected = [function(float(value)) for value in x.ravel()]
        assert_array_equal(function(x), np.reshape(expected, x.shape))
    assert log(np.ones((0, 2))).shape == (0, 2)
