"""How many 95 % intervals hold the true mean, from 3, 10 and 30 worlds.

    python benchmarks/intervals.py

Populations are like those that the bench met on 100 test worlds a kind: success and IoU of a
network by world, and the paired differences of two networks. What is told of each: the share of
intervals that hold the population's mean.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenegen.model.evaluation.statistics import Scale, figure

WORLDS = (3, 10, 30)
Rng = np.random.Generator


@dataclass(frozen=True)
class Population:
    """Samples of worlds that differ."""

    name: str
    scale: Scale
    mean: float
    samples: tuple[int, int]
    """The least and the most samples of a world."""
    draw: Callable[[Rng, NDArray[np.int64], int], NDArray[Any]]
    """Makes the samples of `worlds` (N,), a number for each sample, of so many worlds."""


def success(name: str, mean: float, spread: float, samples: tuple[int, int]) -> Population:
    """Trials in worlds whose shares of success have this mean and standard deviation."""

    def draw(rng: Rng, worlds: NDArray[np.int64], count: int) -> NDArray[Any]:
        return rng.random(len(worlds)) < _shares(rng, mean, spread, count)[worlds]

    return Population(name, "outcome", mean, samples, draw)


def gain(name: str, won: float, lost: float, samples: tuple[int, int]) -> Population:
    """Trials that one of two methods alone wins, in shares that differ by half of themselves from
    world to world."""

    def draw(rng: Rng, worlds: NDArray[np.int64], count: int) -> NDArray[Any]:
        more, fewer = (share * rng.gamma(4, 0.25, count)[worlds] for share in (won, lost))
        chance = rng.random(len(worlds))
        return (chance < more).astype(int) - (chance > 1 - fewer)

    return Population(name, "gain", won - lost, samples, draw)


def iou(name: str, mean: float, spread: float, within: float) -> Population:
    """Maps of worlds whose mean IoU has this standard deviation, and that of maps within a
    world."""

    def draw(rng: Rng, worlds: NDArray[np.int64], count: int) -> NDArray[Any]:
        middle = _shares(rng, mean, spread, count)[worlds]
        sharp = np.maximum(middle * (1 - middle) / within**2 - 1, 0.5)
        return rng.beta(middle * sharp, (1 - middle) * sharp)

    return Population(name, "share", mean, (4, 5), draw)


def difference(name: str, mean: float, spread: float, within: float) -> Population:
    """Differences, map by map, that vary so much from world to world and within one."""

    def draw(rng: Rng, worlds: NDArray[np.int64], count: int) -> NDArray[Any]:
        return mean + rng.normal(0, spread, count)[worlds] + rng.normal(0, within, len(worlds))

    return Population(name, "amount", mean, (4, 5), draw)


USUAL, FEW = (15, 25), (3, 5)
POPULATIONS = (
    success("success, geometric", 0.83, 0.15, USUAL),
    success("success, pillar", 0.91, 0.06, USUAL),
    success("success, pillar, of 200 trials", 0.91, 0.06, (50, 80)),
    gain("difference of success", 0.06, 0.03, USUAL),
    iou("IoU, geometric", 0.74, 0.14, 0.05),
    iou("IoU, pillar", 0.58, 0.05, 0.067),
    difference("difference of IoU", 0.008, 0.007, 0.01),
)
SPARSE = (
    success("success, geometric, few trials", 0.83, 0.15, FEW),
    success("success, pillar, few trials", 0.91, 0.06, FEW),
    gain("difference of success, few trials", 0.06, 0.03, FEW),
)
"""Three to five trials a world: so few outcomes that no interval can hold exactly 95 % of the
time."""


def coverage(population: Population, worlds: int, repeats: int, seed: int = 0) -> float:
    """The share of `repeats` intervals from `worlds` worlds that hold the mean of `population`."""
    rng, held = np.random.default_rng(seed), 0
    for _ in range(repeats):
        least, most = population.samples
        member = np.repeat(np.arange(worlds), rng.integers(least, most + 1, worlds))
        found = figure(population.draw(rng, member, worlds), member, population.scale)
        assert found["low"] is not None
        assert found["high"] is not None
        held += found["low"] <= population.mean <= found["high"]
    return held / repeats


def _shares(rng: Rng, mean: float, spread: float, count: int) -> NDArray[np.float64]:
    sharp = mean * (1 - mean) / spread**2 - 1
    return rng.beta(mean * sharp, (1 - mean) * sharp, count)


def main() -> None:
    """Print a row for each population."""
    import measuring  # beside this file; the test of intervals imports the rest without it

    parser = measuring.options(__doc__)
    parser.add_argument("--repeats", type=int, default=10_000)
    options = measuring.parse(parser, repeats=20)
    print(f"{'worlds':34}", *(f"{worlds:6}" for worlds in WORLDS))
    for population in (*POPULATIONS, *SPARSE):
        cells = (f"{coverage(population, worlds, options.repeats):6.3f}" for worlds in WORLDS)
        print(f"{population.name:34}", *cells, flush=True)


if __name__ == "__main__":
    main()
