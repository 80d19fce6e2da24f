"""Means with their uncertainty, and as text. Samples of one world are not independent, so worlds
are left out in turn.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit, logit, stdtr, stdtrit

from lidarsim.grid import Floats
from scenegen.base.files import Json

Scale = Literal["amount", "share", "outcome", "gain"]
"""Kind of values: any numbers; shares of something, in [0, 1]; successes and failures, 1 and 0; or
differences of these."""
LEVEL = 0.95
"""The share of intervals that hold the true mean: `benchmarks/intervals.py`."""
FEW_WORLDS = 10
"""With fewer worlds an interval rests on too little to be relied on, although as many of them
hold."""
FLIPS = 20000
"""Permutations: the least p-value is one in so many, which must bear a correction over some hundred
tests."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Estimate of a figure over all worlds that could have been drawn, with its error."""

    value: float
    error: float
    """Standard error; NaN where there are fewer than two worlds."""
    freedom: float
    """Degrees of freedom of the error."""

    @property
    def reach(self) -> float:
        """Half the width of the 95 % interval; NaN where the error is."""
        return float(stdtrit(self.freedom, 0.5 + LEVEL / 2)) * self.error

    @property
    def ends(self) -> tuple[float | None, float | None]:
        """The 95 % interval, by Student's t; None twice where there is none."""
        if not math.isfinite(self.value + self.reach):
            return None, None
        return self.value - self.reach, self.value + self.reach

    @property
    def chance(self) -> float | None:
        """Two-sided probability of a value so far from 0 where the truth is 0; None where there is
        no interval."""
        if None in self.ends:
            return None
        if not self.error:
            return float(self.value == 0)
        return 2 * float(stdtr(self.freedom, -abs(self.value) / self.error))


def estimate(sums: ArrayLike, worlds: ArrayLike, of: Callable[[Floats], Floats]) -> Estimate:
    """Estimate a function of sums over samples, with its error over worlds.

    The error is the jackknife's, which leaves out one world at a time, with as many degrees of
    freedom as worlds less one (MacKinnon, Nielsen and Webb, "Fast and reliable jackknife and
    bootstrap methods for cluster-robust inference", Journal of Applied Econometrics 38, 2023). A
    bootstrap that draws worlds again is far too narrow where worlds are few.

    Args:
        sums: Sums of each sample, (N, k).
        worlds: Its world, (N,).
        of: Function from sums (draws, k) to values (draws,).

    Returns:
        The estimate.
    """
    _, member = np.unique(worlds, return_inverse=True)
    totals = np.zeros((member.max(initial=-1) + 1, np.shape(sums)[1]))
    np.add.at(totals, member, np.asarray(sums, float))
    # a world without a value tells nothing, and would count as a degree of freedom
    totals = totals[totals.any(axis=1)]
    count, whole = len(totals), totals.sum(axis=0)
    value = float(of(whole[None])[0])
    if count < 2:
        # one world says nothing of how worlds differ
        return Estimate(value=value, error=math.nan, freedom=1)
    without = of(whole - totals)
    error = math.sqrt((count - 1) / count * float(((without - value) ** 2).sum()))
    return Estimate(value=value, error=error, freedom=count - 1)


def summarise(values: ArrayLike, worlds: ArrayLike, scale: Scale = "amount") -> Json:
    """Summarise a metric: its mean with an interval, as JSON holds it.

    Intervals of shares and outcomes are symmetric in log-odds, so that they stay in [0, 1] and
    cover where a few worlds are far harder than the rest. Outcomes of a few trials can be all alike
    by chance: there the error is at least that of independent trials of which one more went the
    other way.

    Args:
        values: Values of samples, (N,); NaN values are left out.
        worlds: The samples' worlds, (N,).
        scale: Kind of the values.

    Returns:
        ``mean``; ``std`` of the samples (n - 1 in its denominator, None of one), their spread and
        not the mean's error; ``low`` and ``high``, the 95 % interval of the mean, None of one
        world, which says nothing of others; and ``n``, the samples that have a value. Without any,
        all but ``n`` are None.
    """
    values = np.asarray(values, float)
    has_value = np.isfinite(values)
    if not has_value.any():
        return {"mean": None, "std": None, "low": None, "high": None, "n": 0}
    chosen, count = values[has_value], int(has_value.sum())
    estimated = estimate(
        np.stack([chosen, np.ones(count)], axis=1), np.asarray(worlds)[has_value], _mean
    )
    mean, reach = estimated.value, estimated.reach
    low, high = estimated.ends
    if low is not None and high is not None:
        # ten successes in ten trials have no spread, and are no proof that the next succeeds
        if scale in ("outcome", "gain"):
            reach = max(reach, math.sqrt(float(((chosen - mean) ** 2).sum()) + 1) / count)
            low, high = mean - reach, mean + reach
        # the delta method: an error in log-odds is greater by the slope of the logit there
        middle = (chosen.sum() + 0.5) / (count + 1) if scale == "outcome" else mean
        if scale in ("share", "outcome") and 0 < middle < 1:
            ends = expit(logit(middle) + np.array([-1, 1]) * reach / (middle * (1 - middle)))
            # `middle` is drawn towards a half, so an end could pass the mean
            low, high = min(float(ends[0]), mean), max(float(ends[1]), mean)
    std = float(chosen.std(ddof=1)) if count > 1 else None
    return {"mean": mean, "std": std, "low": low, "high": high, "n": count}


def caution(worlds: int) -> str:
    """Caution about intervals over so many worlds; "" if these are enough."""
    if worlds >= FEW_WORLDS:
        return ""
    counted = f"{worlds} world{'s' * (worlds != 1)}"
    return f"{counted}: too few to rely on the intervals; measure {FEW_WORLDS} or more"


def paired_p(
    first: ArrayLike, second: ArrayLike, worlds: ArrayLike, *, rng: np.random.Generator
) -> float:
    """Test whether two methods do equally well on the same samples.

    A sign-flip permutation test on the worlds' summed differences: under the hypothesis, which
    method is which is a coin toss in every world. Samples where either is NaN are left out.

    Args:
        first: Values of one method, (N,).
        second: Values of the other, (N,).
        worlds: The samples' worlds, (N,).
        rng: Draws the flips.

    Returns:
        The two-sided p-value; 1 where none differs.
    """
    difference = np.subtract(first, second, dtype=float)
    held = np.isfinite(difference)
    if not held.any():
        return 1.0
    _, member = np.unique(np.asarray(worlds)[held], return_inverse=True)
    sums = np.bincount(member, weights=difference[held])
    observed = abs(sums.sum())
    flipped = np.abs((rng.integers(2, size=(FLIPS, len(sums)), dtype=np.int8) * 2.0 - 1.0) @ sums)
    # the observed signs count as one flip, so p is never 0; and rounding must not break ties
    return float((1 + (flipped >= observed * (1 - 1e-12)).sum()) / (1 + FLIPS))


def holm(p_values: ArrayLike) -> Floats:
    """Correct p-values (m,) for their number (Holm 1979)."""
    values = np.asarray(p_values, float)
    order = np.argsort(values)
    # the least of m is multiplied by m, the next by m - 1; none may fall below one before it
    stepped = np.maximum.accumulate(values[order] * (len(values) - np.arange(len(values))))
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected


def _mean(sums: Floats) -> Floats:
    """Means (draws,) of sums and counts (draws, 2)."""
    return sums[:, 0] / sums[:, 1]


def cell(metric: Json) -> str:
    """Write a result of `summarise`: mean, standard deviation, interval, and threshold; a dash if
    nothing was measured."""
    if not metric["n"]:
        return "–"
    return f"{with_std(metric['mean'], metric['std'])} {interval(metric, '.3f')}{threshold(metric)}"


def brief(metric: Json, form: str = ".3f") -> str:
    """Write a mean and its interval; a dash where nothing was measured.

    Args:
        metric: From `summarise`.
        form: Format of the numbers.
    """
    return f"{metric['mean']:{form}} {interval(metric, form)}" if metric["n"] else "–"


def threshold(metric: Json) -> str:
    """Write the threshold of a metric; "" if it is the usual one."""
    return f" at {metric['at']}" if metric.get("at") else ""


def interval(metric: Json, form: str) -> str:
    """Write [low, high], or a dash where one world gives none.

    Args:
        metric: From `summarise`.
        form: Format of the numbers.
    """
    return "[–]" if metric["low"] is None else f"[{metric['low']:{form}}, {metric['high']:{form}}]"


def with_std(mean: float, std: float | None = None) -> str:
    """Write a mean, with its standard deviation if there is one.

    Args:
        mean: The mean.
        std: The standard deviation.
    """
    return f"{mean:.3f}" if std is None else f"{mean:.3f} ± {std:.3f}"
