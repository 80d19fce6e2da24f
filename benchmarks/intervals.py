"""How many 95 % intervals hold the true mean, from 3, 10 and 30 worlds.

    python benchmarks/intervals.py

Populations are like those that the bench met on 100 test worlds a kind: success and IoU of a
network by world, and the paired differences of two networks. What is told of each: the share of
intervals that hold the population's mean.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim.grid import Floats, Ints
from scenegen.model.bench.statistics import Scale, summarise

WORLDS = (3, 10, 30)
REPEATS = 10_000
Rng = np.random.Generator


@dataclass(frozen=True)
class Population:
    """Samples of worlds that differ: outcomes of trials, in worlds that have shares of success;
    gains, where one of two methods alone wins, in shares that differ by half of themselves from
    world to world; or shares and amounts, by map, that differ within a world, too."""

    name: str
    scale: Scale
    samples: tuple[int, int]
    """The least and the most samples of a world."""
    mean: float
    spread: float = 0.0
    """Standard deviation of the worlds' means."""
    within: float = 0.0
    """That within a world."""
    lost: float = 0.0
    """Of gains, the share in which the second method wins."""

    def draw(self, rng: Rng, worlds: Ints, count: int) -> Any:
        """Samples of `worlds` (N,), a number for each sample, of so many worlds."""
        match self.scale:
            case "outcome":
                return rng.random(len(worlds)) < self._shares(rng, count)[worlds]
            case "gain":
                shares = (self.mean + self.lost, self.lost)
                more, fewer = (share * rng.gamma(4, 0.25, count)[worlds] for share in shares)
                chance = rng.random(len(worlds))
                return (chance < more).astype(int) - (chance > 1 - fewer)
            case "share":
                middle = self._shares(rng, count)[worlds]
                sharp = np.maximum(middle * (1 - middle) / self.within**2 - 1, 0.5)
                return rng.beta(middle * sharp, (1 - middle) * sharp)
        of_worlds = rng.normal(0, self.spread, count)[worlds]
        return self.mean + of_worlds + rng.normal(0, self.within, len(worlds))

    def _shares(self, rng: Rng, count: int) -> Floats:
        """Worlds' shares, (count,)."""
        sharp = self.mean * (1 - self.mean) / self.spread**2 - 1
        return rng.beta(self.mean * sharp, (1 - self.mean) * sharp, count)


USUAL, FEW, MAPS = (15, 25), (3, 5), (4, 5)
POPULATIONS = (
    Population("success, geometric", "outcome", USUAL, 0.83, 0.15),
    Population("success, pillar", "outcome", USUAL, 0.91, 0.06),
    Population("success, pillar, of 200 trials", "outcome", (50, 80), 0.91, 0.06),
    Population("difference of success", "gain", USUAL, 0.03, lost=0.03),
    Population("IoU, geometric", "share", MAPS, 0.74, 0.14, 0.05),
    Population("IoU, pillar", "share", MAPS, 0.58, 0.05, 0.067),
    Population("difference of IoU", "amount", MAPS, 0.008, 0.007, 0.01),
)
SPARSE = (
    Population("success, geometric, few trials", "outcome", FEW, 0.83, 0.15),
    Population("success, pillar, few trials", "outcome", FEW, 0.91, 0.06),
    Population("difference of success, few trials", "gain", FEW, 0.03, lost=0.03),
)
"""Three to five trials a world: so few outcomes that no interval can hold exactly 95 % of the
time."""


def coverage(population: Population, worlds: int, repeats: int, seed: int = 0) -> float:
    """The share of `repeats` intervals from `worlds` worlds that hold the mean of `population`."""
    rng, held = np.random.default_rng(seed), 0
    least, most = population.samples
    for _ in range(repeats):
        member = np.repeat(np.arange(worlds), rng.integers(least, most + 1, worlds))
        found = summarise(population.draw(rng, member, worlds), member, population.scale)
        held += found["low"] <= population.mean <= found["high"]
    return held / repeats


def main() -> None:
    """Print a row for each population."""
    import measuring  # beside this file; the test of intervals imports the rest without it

    repeats = 20 if measuring.parse(measuring.Options).smoke else REPEATS
    print(f"{'worlds':34}", *(f"{worlds:6}" for worlds in WORLDS))
    for population in (*POPULATIONS, *SPARSE):
        cells = (f"{coverage(population, worlds, repeats):6.3f}" for worlds in WORLDS)
        print(f"{population.name:34}", *cells, flush=True)


if __name__ == "__main__":
    main()
