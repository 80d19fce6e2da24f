"""Sine, cosine, exponential and logarithm whose bits are the same on every processor.

The mathematical library and numpy choose among several implementations by the processor's features
(FMA, AVX-512), and these differ in the last bit. Here everything is made of + - * / and rounding to
whole numbers, which IEEE 754 makes exact to the bit. Sums are carried as two float64, a number and
the rounding error (Dekker 1971), about 100 bits, so that results are the float64 nearest to the
true value but for about one in 10^12."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.grid import Floats
from lidarsim.jit import kernel

HALF_PI = (1.5707963267948966, 6.123233995736766e-17, -1.4973849048591833e-33)
"""π/2 as a sum."""
LN_2 = (0.6931471805599453, 2.3190468138462996e-17, 5.707708438416212e-34)
"""The logarithm of 2 as a sum."""
TERMS = 28
"""Terms of every power series: more than enough for 2^-107."""


def sin_cos(angle: ArrayLike) -> tuple[Floats, Floats]:
    """Compute sine and cosine of angles (...) in radians, up to 10^9 in magnitude; NaN if not
    finite."""
    angles = np.asarray(angle, float)
    sine, cosine = np.empty(angles.shape), np.empty(angles.shape)
    _sin_cos(np.ravel(angles), sine.reshape(-1), cosine.reshape(-1))
    return sine, cosine


def exp(value: ArrayLike) -> Floats:
    """Compute e to the power of `value` (...)."""
    return _elementwise(_exp, value)


def log(value: ArrayLike) -> Floats:
    """Compute the natural logarithm of `value` (...); -inf of 0, NaN of negative numbers."""
    return _elementwise(_log, value)


def _elementwise(fill: Callable[..., None], value: ArrayLike) -> Floats:
    values = np.asarray(value, float)
    result = np.empty(values.shape)
    fill(np.ravel(values), result.reshape(-1))
    return result


@kernel
def _sum(a, b):
    """a + b exactly: the nearest float64, and its rounding error (Knuth's TwoSum)."""
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


@kernel
def _product(a, b):
    """a * b exactly, without the fused multiply-add that not every processor has (Dekker)."""
    p = a * b
    # 2^27 + 1 splits a float64 into halves of 26 bits, whose products are exact (Veltkamp)
    c, d = 134217729.0 * a, 134217729.0 * b
    a1, b1 = c - (c - a), d - (d - b)
    a2, b2 = a - a1, b - b1
    # the order of these differences is Dekker's: each is exact
    return p, a2 * b2 - (((p - a1 * b1) - a2 * b1) - a1 * b2)


@kernel
def _add(a, b):
    """The sum of two pairs."""
    s, e = _sum(a[0], b[0])
    return _sum(s, e + (a[1] + b[1]))


@kernel
def _times(a, b):
    """The product of two pairs."""
    p, e = _product(a[0], b[0])
    return _sum(p, e + (a[0] * b[1] + a[1] * b[0]))


@kernel
def _over(a, b):
    """The quotient of two pairs."""
    # one step of long division: the remainder of the leading quotient gives the correction
    q = a[0] / b[0]
    p = _times(b, (q, 0.0))
    return _sum(q, ((a[0] - p[0]) - p[1] + a[1]) / b[0])


@kernel
def _less_multiple(x, k, constant):
    """x - k * constant as a pair, k whole: the parts that cancel do so exactly."""
    p, e = _product(k, constant[0])
    q, f = _product(k, constant[1])
    return _add(_add(_sum(x, -p), (-e, 0.0)), (-q, -f - k * constant[2]))


@kernel
def _sin_cos(angle, sine, cosine):
    """Sum Taylor's series of both about the nearest multiple of π/2."""
    for n in range(len(angle)):
        # then |r| is at most π/4, where the series converges fast
        k = math.floor(angle[n] / HALF_PI[0] + 0.5) if math.isfinite(angle[n]) else math.nan
        r = _less_multiple(angle[n], float(k), HALF_PI)
        odd, even, term = (0.0, 0.0), (0.0, 0.0), (1.0, 0.0)
        for m in range(TERMS):
            # terms run 1, r, -r²/2, -r³/6: even ones make the cosine, odd ones the sine
            signed = term if m % 4 < 2 else (-term[0], -term[1])
            if m % 2 == 0:
                even = _add(even, signed)
            else:
                odd = _add(odd, signed)
            term = _over(_times(term, r), (float(m + 1), 0.0))
        # each quarter turn swaps the two, and changes a sign
        quarter = k - 4.0 * math.floor(k / 4.0)
        s, c = odd[0], even[0]
        if quarter == 1.0 or quarter == 3.0:
            s, c = c, s
        sine[n] = -s if quarter >= 2.0 else s
        cosine[n] = -c if quarter == 1.0 or quarter == 2.0 else c


@kernel
def _exp(value, result):
    """Sum Taylor's series about the nearest multiple of log 2, and scale by a power of 2."""
    for n in range(len(value)):
        x = min(max(value[n], -800.0), 800.0)  # beyond, the result is 0 or infinite
        k = math.floor(x / LN_2[0] + 0.5)
        r = _less_multiple(x, float(k), LN_2)
        total, term = (0.0, 0.0), (1.0, 0.0)
        for m in range(TERMS):
            total = _add(total, term)
            term = _over(_times(term, r), (float(m + 1), 0.0))
        result[n] = math.ldexp(total[0], int(k))


@kernel
def _log(value, result):
    for n in range(len(value)):
        result[n] = log_of(value[n])


@kernel
def log_of(x):
    """Compute the logarithm of one number, for kernels.

    log(m 2^k) = k log 2 + 2 artanh((m - 1) / (m + 1)) with m from 0.7 to 1.4, by the series of
    artanh."""
    if not 0.0 < x < math.inf:
        return -math.inf if x == 0.0 else (x if x > 0.0 else math.nan)
    m, k = math.frexp(x)
    # frexp gives m from 0.5 to 1; the series wants it centred on 1
    if m < 0.7071067811865476:
        m, k = 2.0 * m, k - 1
    # |s| is at most 0.172, so each term is 34 times smaller than the one before
    s = _over((m - 1.0, 0.0), _sum(m, 1.0))
    square, power, total = _times(s, s), s, (0.0, 0.0)
    for i in range(TERMS):
        total = _add(total, _over(power, (float(2 * i + 1), 0.0)))
        power = _times(power, square)
    shift = _less_multiple(0.0, float(-k), LN_2)
    return _add(shift, (2.0 * total[0], 2.0 * total[1]))[0]
