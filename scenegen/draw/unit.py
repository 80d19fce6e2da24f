"""A unit: one flight and its samples; the key of its random numbers."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from scenegen import SPLITS
from scenegen.draw.sample import Sample
from scenegen.worlds.world import AnyWorld

WORLD, FLIGHT, NOISE = 0, 1, 2
"""Streams of random numbers of a unit."""


class UnitKey(NamedTuple):
    """Key of a unit's random numbers."""

    seed: int
    """Seed of the dataset."""
    split: str
    """ "train", "val" or "test"."""
    unit: int
    """Number of the unit in its split."""

    def rng(self, stream: int, attempt: int, *part: int) -> Generator:
        """Random numbers of one purpose.

        Args:
            stream: `WORLD`, `FLIGHT` or `NOISE`.
            attempt: Number of the draw.
            part: Further parts of the key, such as the number of a view.
        """
        key = SPLITS.index(self.split), self.unit, attempt, stream, *part
        # a stream for each purpose: more noise, for example, must not change the worlds
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))


Rejections = Mapping[str, Counter[str]]
"""Number of rejected draws by reason, of `worlds` and of `viewpoints`."""


def none_rejected() -> Rejections:
    """Empty counts of rejected draws."""
    return {"worlds": Counter(), "viewpoints": Counter()}


@dataclass(frozen=True, eq=False)
class Unit:
    """One flight: its world and samples."""

    number: int
    """Number of the world in its split."""
    world: AnyWorld
    samples: tuple[Sample, ...]
    rejected: Rejections
