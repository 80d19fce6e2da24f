"""Calibrated probabilities: a temperature and a measure of unfamiliar maps, kept in a network's
file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from lidarsim.grid import Field, Floats, Mask
from lidarsim.parameters import check, number, short_repr
from scenegen.base.files import Json

KEY = "calibration"
"""Name of the calibration in a network's header."""
UNUSUAL = 0.95
"""A map is unfamiliar if its share of denied returns exceeds that of 95 % of the calibration
maps."""
HOME, UNKNOWN = 0.5, 0.9
"""The temperature applies in full up to the first value of `away`, and not at all from the second
on; in between, its logarithm is linear."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A network's calibration. Raises ValueError for numbers that cannot be one."""

    worlds: int = number(minimum=1)
    """Validation worlds that it was computed from."""
    class_weight: float = number(above=0)
    """The weight of occupied voxels in the loss by which the network was trained."""
    temperature: float = number(above=0)
    """What the logits of familiar maps are divided by, after the class weight was inverted."""
    datasets: tuple[str, ...] = ()
    """Digests of the datasets whose validation worlds these are."""
    denied: tuple[float, ...] = ()
    """Quantiles of `denial` over validation maps, at levels that rise in equal steps up to 1; ()
    where that was not measured."""

    def __post_init__(self) -> None:
        check(self)

    @classmethod
    def of(cls, about: Json) -> "Calibration | None":
        """Read the calibration from a network's header.

        Args:
            about: What the header says about the network. Entries of earlier versions that this
                one does not use, such as bounds of distance, are ignored.

        Returns:
            The calibration; None where there is none, or it has no probabilities.

        Raises:
            ValueError: if it is damaged.
        """
        try:
            entry = {
                field.name: about[KEY][field.name]
                for field in fields(cls)
                if field.name in about.get(KEY, {})
            }
            if entry.get("temperature") is None:
                return None
            return cls(**entry)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"its calibration is damaged ({short_repr(error)}); calibrate it again"
            ) from None

    def chance(self, probability: Field | None, away: Any) -> Field | None:
        """Calibrated probabilities: with l the logit of p, the probability of (l - log w) / T.

        Args:
            probability: Predicted probabilities (..., X, Y, Z), or None.
            away: How unfamiliar each map is, (...), or None: see `familiar`.

        Returns:
            Probabilities (..., X, Y, Z); None where none are predicted.
        """
        if probability is None:
            return None
        temperature = self.temperature ** familiar(0 if away is None else away)
        logit = corrected_logit(probability, self.class_weight)
        return 1 / (1 + np.exp(-logit / np.asarray(temperature, np.float32)[..., None, None, None]))


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredProbability:
    """Calibrated probabilities of one map that a predictions file holds."""

    probability: Field

    def chance(self, probability: Field | None, away: Any) -> Field | None:
        """See `Calibration.chance`."""
        return self.probability


def away_of(denied: Any, levels: Sequence[float]) -> Floats:
    """How unfamiliar maps are: the share of the `levels` that their share of denied returns
    exceeds."""
    return np.searchsorted(levels, denied) / len(levels)


def familiar(away: Any) -> Floats:
    """The power of the temperature for maps, by how unfamiliar they are: 1 for familiar ones.

    The temperature is valid only for familiar maps. Elsewhere, only the loss says what a logit
    means.
    """
    return np.clip((UNKNOWN - np.asarray(away)) / (UNKNOWN - HOME), 0, 1)


def corrected(probability: Field, class_weight: float) -> Field:
    """Probabilities whose class weight w is inverted: q = p / (p + w (1 - p)).

    A network trained with w on occupied voxels, where a free one has 1, minimises its loss by
    saying p = w q / (w q + 1 - q) of a voxel that is occupied with probability q.
    """
    p = probability.astype(np.float32)
    return np.asarray(p / (p + np.float32(class_weight) * (1 - p)), np.float32)


def denial(probability: Field, observed: Mask, class_weight: float) -> Any:
    """The share of a map's `observed` voxels that are said to be free sooner than occupied, or of
    each map's, (...), from (..., X, Y, Z); 0 where nothing was observed."""
    missed, axes = observed & (corrected(probability, class_weight) <= 0.5), (-3, -2, -1)
    return missed.sum(axis=axes) / np.maximum(observed.sum(axis=axes), 1)


def corrected_logit(probability: Field, class_weight: float) -> Field:
    """The logits of `corrected` probabilities: those of p less log w. 0 and 1 count as the nearest
    numbers that float32 tells from them."""
    p = np.clip(probability.astype(np.float32), np.float32(1e-7), np.float32(1 - 1e-7))
    return np.log(p / (1 - p)) - np.float32(math.log(class_weight))
