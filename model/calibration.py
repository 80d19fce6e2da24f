"""Calibrated probabilities: a temperature, and a measure of how unfamiliar a map is. Both are
stored in a network's file."""

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
"""Full temperature up to the first value of `away`, none from the second on; its logarithm is
linear in between."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A network's calibration.

    Raises:
        ValueError: if a number is out of its bounds.
    """

    worlds: int = number(minimum=1)
    """Number of validation worlds that it was computed from."""
    class_weight: float = number(above=0)
    """Weight of occupied voxels in the loss of the training; free ones have 1."""
    temperature: float = number(above=0)
    """Divisor of the logits of familiar maps, after the class weight was inverted."""
    datasets: tuple[str, ...] = ()
    """Digests of the datasets of these worlds."""
    denied: tuple[float, ...] = ()
    """Quantiles of `denial` over validation maps, at levels that rise in equal steps up to 1; () if
    not measured."""

    def __post_init__(self) -> None:
        check(self)

    @classmethod
    def of(cls, metadata: Json) -> "Calibration | None":
        """Read the calibration from a network's metadata.

        Args:
            metadata: Metadata in the network's file. Entries of earlier versions that this one does
                not use, such as bounds of distance, are ignored.

        Returns:
            The calibration; None if there is none, or if it has no temperature.

        Raises:
            ValueError: if it is damaged.
        """
        try:
            entry = {
                field.name: metadata[KEY][field.name]
                for field in fields(cls)
                if field.name in metadata.get(KEY, {})
            }
            # versions up to 0.2 calibrated networks without occupancy, too: their distances
            if entry.get("temperature") is None:
                return None
            return cls(**entry)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"its calibration is damaged ({short_repr(error)}); calibrate it again"
            ) from None

    def chance(self, probability: Field | None, away: Any) -> Field | None:
        """Calibrate probabilities: sigmoid((logit(p) - log w) / T), with the class weight w and the
        temperature T, or a part of it if the map is unfamiliar.

        Args:
            probability: Predicted probabilities (..., X, Y, Z); None for a network that predicts
                distances only.
            away: How unfamiliar each map is, (...), as `away_of` gives it; None counts as familiar.

        Returns:
            Probabilities (..., X, Y, Z) float32; None if none are predicted.
        """
        if probability is None:
            return None
        # a power of T is a factor of log T
        temperature = self.temperature ** familiar(0 if away is None else away)
        logit = corrected_logit(probability, self.class_weight)
        return 1 / (1 + np.exp(-logit / np.asarray(temperature, np.float32)[..., None, None, None]))


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredProbability:
    """Calibrated probabilities of one map, read from a predictions file. Stands for the
    `Calibration` of the network, which is not at hand there."""

    probability: Field
    """(X, Y, Z)."""

    def chance(self, probability: Field | None, away: Any) -> Field | None:
        """Return the stored probabilities.

        Args:
            probability: Not used; see `Calibration.chance`.
            away: Not used.

        Returns:
            Probabilities (X, Y, Z).
        """
        return self.probability


def away_of(denied: Any, levels: Sequence[float]) -> Floats:
    """Return how unfamiliar maps are.

    Args:
        denied: `denial` of each map, (...).
        levels: `Calibration.denied`: rising quantiles of validation maps.

    Returns:
        (...): share of the validation maps that had fewer denied returns, 0 to 1.
    """
    return np.searchsorted(levels, denied) / len(levels)


def familiar(away: Any) -> Floats:
    """Power of the temperature for maps, (...): 1 for familiar ones, 0 for unfamiliar ones.

    The temperature is valid only for familiar maps. In real places, probabilities that were
    calibrated in generated worlds are too sure (docs/uncertainty.md).
    """
    return np.clip((UNKNOWN - np.asarray(away)) / (UNKNOWN - HOME), 0, 1)


def corrected(probability: Field, class_weight: float) -> Field:
    """Invert the class weight w of the loss: q = p / (p + w (1 - p)).

    For a voxel that is occupied with probability q, the loss is lowest at p = w q / (w q + 1 - q),
    if occupied voxels weigh w and free ones 1.

    Args:
        probability: Predicted probabilities p, any shape.
        class_weight: w.

    Returns:
        Probabilities q, float32, of the same shape.
    """
    p = probability.astype(np.float32)
    return np.asarray(p / (p + np.float32(class_weight) * (1 - p)), np.float32)


def denial(probability: Field, observed: Mask, class_weight: float) -> Any:
    """Share of denied returns: of the voxels with a return, those that are predicted free.

    Args:
        probability: Predicted probabilities (..., X, Y, Z).
        observed: Voxels that hold a return, (..., X, Y, Z).
        class_weight: Weight of occupied voxels in the loss of the training.

    Returns:
        (...): a share for each map, 0 to 1; 0 if nothing was observed.
    """
    # a corrected probability of at most 0.5 means free rather than occupied
    missed, axes = observed & (corrected(probability, class_weight) <= 0.5), (-3, -2, -1)
    return missed.sum(axis=axes) / np.maximum(observed.sum(axis=axes), 1)


def corrected_logit(probability: Field, class_weight: float) -> Field:
    """Logits of `corrected` probabilities: logit(p) - log w.

    Args:
        probability: Predicted probabilities p, any shape.
        class_weight: Weight w of occupied voxels in the loss of the training.

    Returns:
        Finite logits, float32, of the same shape.
    """
    # 1 - 1e-7 is about the largest float32 below 1; 0 and 1 themselves have no finite logit
    p = np.clip(probability.astype(np.float32), np.float32(1e-7), np.float32(1 - 1e-7))
    return np.log(p / (1 - p)) - np.float32(math.log(class_weight))
