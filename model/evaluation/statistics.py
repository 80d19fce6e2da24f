"""Figures with their uncertainty. Samples of one world are not independent, so worlds are what is drawn again."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

DRAWS = 2000
"""Bootstrap resamples: the 2.5 % points wander by some hundredth of the interval."""
FLIPS = 20000
"""Permutations: the least p-value is one in so many, which must bear a correction over some hundred tests."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A mean over samples, with their spread, and a 95 % interval for the mean."""

    mean: float | None
    """None where no sample has a value."""
    std: float | None
    """Standard deviation of the samples: their spread, not the mean's error."""
    low: float | None
    """Lower end of the interval; None where the samples are of one world, which says nothing of others."""
    high: float | None
    n: int
    """Samples that have a value."""


def summarize(values: ArrayLike, worlds: ArrayLike, *, rng: np.random.Generator) -> Figure:
    """A figure from `values` (N,) of samples from `worlds` (N,); NaN values are left out.

    The interval is the percentile bootstrap over worlds: as many as there are, drawn with replacement, each with all
    its samples (a cluster bootstrap; Cameron, Gelbach and Miller 2008).
    """
    values = np.asarray(values, dtype=np.float64)
    held = np.isfinite(values)
    if not held.any():
        return Figure(mean=None, std=None, low=None, high=None, n=0)
    sums, counts = _by_world(values[held], np.asarray(worlds)[held])
    weights = resamples(len(sums), rng)
    low, high = np.percentile((weights @ sums) / np.maximum(weights @ counts, 1), [2.5, 97.5])
    several = len(sums) > 1
    return Figure(
        mean=float(values[held].mean()),
        std=float(values[held].std(ddof=1)) if held.sum() > 1 else 0.0,
        low=float(low) if several else None,
        high=float(high) if several else None,
        n=int(held.sum()),
    )


def figure(values: ArrayLike, worlds: ArrayLike, *, rng: np.random.Generator) -> dict[str, Any]:
    """What `summarize` gives, as JSON holds it."""
    return dataclasses.asdict(summarize(values, worlds, rng=rng))


def interval(
    sums: ArrayLike,
    worlds: ArrayLike,
    of: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    *,
    rng: np.random.Generator,
) -> tuple[float | None, float | None]:
    """The 95 % interval, by the same bootstrap, of what `of` makes of sums (draws, k) over all samples, as (draws,).

    `sums` (N, k) are those of each sample, of `worlds` (N,). Both ends are None where there is one world or none.
    """
    names, member = np.unique(worlds, return_inverse=True)
    if len(names) < 2:
        return None, None
    totals = np.zeros((len(names), np.shape(sums)[1]))
    np.add.at(totals, member, np.asarray(sums, dtype=np.float64))
    low, high = np.percentile(of(resamples(len(names), rng) @ totals), [2.5, 97.5])
    return float(low), float(high)


def paired_p(first: ArrayLike, second: ArrayLike, worlds: ArrayLike, *, rng: np.random.Generator) -> float:
    """Two-sided p-value that two methods do equally well on the same samples (N,) each.

    A sign-flip permutation test on the worlds' summed differences: under the hypothesis, which method is which is a
    coin toss in every world. Samples where either is NaN are left out; 1 where none differs.
    """
    difference = np.asarray(first, dtype=np.float64) - np.asarray(second, dtype=np.float64)
    held = np.isfinite(difference)
    if not held.any():
        return 1.0
    sums, _ = _by_world(difference[held], np.asarray(worlds)[held])
    observed = abs(sums.sum())
    flipped = np.abs((rng.integers(2, size=(FLIPS, len(sums)), dtype=np.int8) * 2.0 - 1.0) @ sums)
    return float((1 + (flipped >= observed * (1 - 1e-12)).sum()) / (1 + FLIPS))


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """P-values (m,) corrected for their number (Holm 1979)."""
    given = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(given)
    stepped = np.maximum.accumulate(given[order] * (len(given) - np.arange(len(given))))
    corrected = np.empty_like(given)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected


def resamples(worlds: int, rng: np.random.Generator, draws: int = DRAWS) -> NDArray[np.int64]:
    """How often each of `worlds` stands in each of `draws` bootstrap resamples, (draws, worlds).

    Names are drawn and counted, which takes an eighth of what `rng.multinomial` does.
    """
    drawn = rng.integers(worlds, size=(draws, worlds)) + worlds * np.arange(draws)[:, None]
    return np.bincount(drawn.ravel(), minlength=draws * worlds).reshape(draws, worlds)


def _by_world(
    values: NDArray[np.float64], worlds: NDArray[np.generic]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums and counts of the values of every world."""
    _, member = np.unique(worlds, return_inverse=True)
    return np.bincount(member, weights=values).astype(np.float64), np.bincount(member).astype(np.float64)
