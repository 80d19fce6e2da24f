"""Sine, cosine, exponential and logarithm whose bits are the same on every processor.

The mathematical library and numpy choose among several implementations by what the processor offers
(FMA, AVX-512), and these differ in the last bit. Here everything is made of + - * / and rounding to
whole numbers, which IEEE 754 makes exact to the bit. Sums are carried as two float64, a number and
what rounding cut off it (Dekker 1971), about 100 bits, so that results are the float64 nearest to
the true value but for one in some 10^12.
"""

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
    """Sine and cosine of angles (...) in radians, up to 10^9 in magnitude; NaN for what is not
    finite."""
    given = np.asarray(angle, float)
    sine, cosine = np.empty(given.shape), np.empty(given.shape)
    _sin_cos(np.ravel(given), sine.reshape(-1), cosine.reshape(-1))
    return sine, cosine


def exp(value: ArrayLike) -> Floats:
    """e to the power of `value` (...)."""
    return _each(_exp, value)


def log(value: ArrayLike) -> Floats:
    """The natural logarithm of `value` (...); -inf of 0, NaN of what is negative."""
    return _each(_log, value)


def _each(fill: Callable[..., None], value: ArrayLike) -> Floats:
    given = np.asarray(value, float)
    result = np.empty(given.shape)
    fill(np.ravel(given), result.reshape(-1))
    return result


@kernel
def _sum(a, b):
    """a + b exactly: the float64 nearest to it, and the rest (Knuth)."""
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


@kernel
def _product(a, b):
    """a * b exactly, without the fused multiply-add that not every processor has (Dekker)."""
    p = a * b
    c, d = 134217729.0 * a, 134217729.0 * b
    a1, b1 = c - (c - a), d - (d - b)
    a2, b2 = a - a1, b - b1
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
    """Taylor's series of both, about the nearest multiple of π/2."""
    for n in range(len(angle)):
        k = math.floor(angle[n] / HALF_PI[0] + 0.5) if math.isfinite(angle[n]) else math.nan
        r = _less_multiple(angle[n], float(k), HALF_PI)
        odd, even, term = (0.0, 0.0), (0.0, 0.0), (1.0, 0.0)
        for m in range(TERMS):
            signed = term if m % 4 < 2 else (-term[0], -term[1])
            if m % 2 == 0:
                even = _add(even, signed)
            else:
                odd = _add(odd, signed)
            term = _over(_times(term, r), (float(m + 1), 0.0))
        quarter = k - 4.0 * math.floor(k / 4.0)
        s, c = odd[0], even[0]
        if quarter == 1.0 or quarter == 3.0:
            s, c = c, s
        sine[n] = -s if quarter >= 2.0 else s
        cosine[n] = -c if quarter == 1.0 or quarter == 2.0 else c


@kernel
def _exp(value, result):
    """Taylor's series about the nearest multiple of log 2, and a power of 2."""
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
    """The logarithm of one number, for kernels: log(m 2^k) = k log 2 + 2 artanh((m - 1) / (m + 1))
    with m from 0.7 to 1.4, by the series of artanh."""
    if not 0.0 < x < math.inf:
        return -math.inf if x == 0.0 else (x if x > 0.0 else math.nan)
    m, k = math.frexp(x)
    if m < 0.7071067811865476:
        m, k = 2.0 * m, k - 1
    s = _over((m - 1.0, 0.0), _sum(m, 1.0))
    square, power, total = _times(s, s), s, (0.0, 0.0)
    for i in range(TERMS):
        total = _add(total, _over(power, (float(2 * i + 1), 0.0)))
        power = _times(power, square)
    shift = _less_multiple(0.0, float(-k), LN_2)
    return _add(shift, (2.0 * total[0], 2.0 * total[1]))[0]
