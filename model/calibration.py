"""How sure a network is: calibrated probabilities and bounds of distance, from margins kept in its
file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lidarsim.grid import Field, Floats, GridSpec, Ints, Mask
from lidarsim.parameters import check, number
from scenegen.errors import ScenegenError, short
from scenegen.files import Json

KEY = "calibration"
"""The calibration's name in what is said about a network."""
RISK = 0.05
"""The risk of a bound where none is named: the truth is at least the bound in 95 % of unknown
voxels."""
UNUSUAL = 0.95
"""A map that is farther from home than this share of those of calibration is away."""
HOME, UNKNOWN = 0.5, 0.9
"""Maps that are no farther from home than this share of those of calibration have its temperature,
and farther than that have none; in between, its logarithm falls in proportion."""
CLOSE = 1e-9
"""Risks that differ by less are the same."""


class UncertaintyError(ScenegenError):
    """Bounds or probabilities are asked for that nobody can give."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A network's calibration. Raises ValueError for numbers that cannot be one."""

    worlds: int = number(least=1)
    """Validation worlds that it was computed from."""
    class_weight: float = number(above=0)
    """The weight of occupied voxels in the loss by which the network was trained."""
    temperature: float | None = number(above=0)
    """What the logits of maps like home are divided by, after the class weight was inverted; None
    where no probability is predicted."""
    step_m: float = number(above=0)
    """Width of the bins of predicted distance, metres; the last one holds what is at the
    truncation."""
    chances: tuple[float, ...] = number(above=0, below=1)
    """Edges between the bins of probability, its class weight inverted, rising; () where none is
    predicted."""
    risks: tuple[float, ...] = number(above=0, below=1)
    """The risks of the rows of `margins`, falling."""
    margins: tuple[tuple[float, ...], ...]
    """(risks, distance bins x probability bins): what is taken from a predicted distance,
    metres."""
    path_risks: tuple[float, ...] = ()
    """For every risk of `risks`, what share of the paths planned on its bounds collides at most:
    see `scenegen.model.evaluation.planning.measure`. () where that was not measured."""
    datasets: tuple[str, ...] = ()
    """Digests of the datasets whose validation worlds these are."""
    denied: tuple[float, ...] = ()
    """What `denial` says of validation maps, at levels that rise in equal steps, up to all of them;
    () where that was not measured."""

    def __post_init__(self) -> None:
        check(self)
        if sorted(self.risks, reverse=True) != list(self.risks) or sorted(self.chances) != list(
            self.chances
        ):
            raise ValueError("its risks must fall, and its probabilities rise")
        if len(self.margins) != len(self.risks):
            raise ValueError("its margins are not a row a risk")
        if len(self.path_risks) not in (0, len(self.risks)):
            raise ValueError("its path_risks must be as many as its risks")

    @classmethod
    def of(cls, about: Json, grid: GridSpec) -> "Calibration | None":
        """The calibration among what is said `about` a network for maps on `grid`; None where there
        is none. Raises ValueError where it is damaged."""
        if KEY not in about:
            return None
        try:
            found = cls(**about[KEY])
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"its calibration is damaged ({short(error)}); calibrate it again"
            ) from None
        width = distance_bins(grid, found.step_m) * (len(found.chances) + 1)
        if any(len(row) != width for row in found.margins):
            raise ValueError("its calibration is of another grid; calibrate it again")
        return found

    def chance(self, probability: Field | None, away: Any) -> Field | None:
        """Calibrated probabilities, (..., X, Y, Z) as the predicted ones, None where there are
        none: with l the logit of p, the probability of (l - log w) / T. `away` tells how far from
        home each map is, (...), or None: see `familiar`."""
        if probability is None or self.temperature is None:
            return None
        temperature = self.temperature ** familiar(0 if away is None else away)
        logit = corrected_logit(probability, self.class_weight)
        return 1 / (1 + np.exp(-logit / np.asarray(temperature, np.float32)[..., None, None, None]))

    def row(self, risk: float) -> int:
        """Which of `risks` serves `risk`: the greatest that is no greater. Raises UncertaintyError
        where none is."""
        if not 0 < risk < 1:
            raise UncertaintyError(
                f"risk = {risk:g}: expected a number between 0 and 1, such as {RISK}"
            )
        for n, held in enumerate(self.risks):
            if held <= risk + CLOSE:
                return n
        least = f"down to {self.risks[-1]:g}" if self.risks else "no bounds"
        raise UncertaintyError(
            f"risk = {risk:g}: {self.worlds} validation worlds give {least}; calibrate on more "
            f"worlds"
        )

    def for_paths(self, risk: float) -> float:
        """The greatest risk of bounds on which a share `risk` of planned paths collides at most:
        risk as one number, to plan by. Raises UncertaintyError where no bounds are so sure, or it
        was not measured."""
        for held, collided in zip(self.risks, self.path_risks, strict=False):
            if collided <= risk + CLOSE:
                return held
        least = (
            f"down to {self.path_risks[-1]:.3g}"
            if self.path_risks
            else "nothing: it was calibrated with --trials 0"
        )
        raise UncertaintyError(f"risk of paths = {risk:g}: the calibration promises {least}")

    def low(self, distance: Field, probability: Field | None, risk: float) -> Field:
        """Distances that the truth falls below in a share `risk` of unknown voxels at most, of the
        shape of the predicted `distance`, metres: the bound of the greatest risk in the table that
        is no greater than `risk`. Raises UncertaintyError for a risk that is too small."""
        margins = np.asarray(self.margins[self.row(risk)], np.float32)
        count = len(margins) // (len(self.chances) + 1)
        chance = None if probability is None else corrected(probability, self.class_weight)
        found = bins(distance, chance, self.step_m, self.chances, count)
        return np.maximum(distance - margins[found], 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """What somebody else says of one map: a calibrated probability, or a bound of one risk, or
    both."""

    probability: Field | None = None
    tudf_low: Field | None = None
    """Distances, metres."""
    risk: float = RISK

    @property
    def risks(self) -> tuple[float, ...]:
        """The risks that there are bounds of."""
        return () if self.tudf_low is None else (self.risk,)

    def chance(self, probability: Field | None, away: Any) -> Field | None:
        """See `Calibration.chance`."""
        return self.probability

    def low(self, distance: Field, probability: Field | None, risk: float) -> Field:
        """See `Calibration.low`."""
        if self.tudf_low is None or risk < self.risk - CLOSE:
            held = "none" if self.tudf_low is None else f"those of a risk of {self.risk:g}"
            raise UncertaintyError(f"risk = {risk:g}: of bounds, the predictions hold {held}")
        return self.tudf_low


def away_of(denied: Any, levels: Sequence[float]) -> Floats:
    """How far from home maps are: the share of the `levels` that what they deny is above."""
    return np.searchsorted(levels, denied) / len(levels)


def familiar(away: Any) -> Floats:
    """The power of the temperature that a map has, by how far from home it is: 1 at home.

    Sureness that was learned at home holds there alone: elsewhere, the loss is all that tells what
    a logit means.
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
    missed, every = observed & (corrected(probability, class_weight) <= 0.5), (-3, -2, -1)
    return missed.sum(axis=every) / np.maximum(observed.sum(axis=every), 1)


def corrected_logit(probability: Field, class_weight: float) -> Field:
    """The logits of `corrected` probabilities: those of p less log w. 0 and 1 count as the nearest
    numbers that float32 tells from them."""
    p = np.clip(probability.astype(np.float32), np.float32(1e-7), np.float32(1 - 1e-7))
    return np.log(p / (1 - p)) - np.float32(math.log(class_weight))


def distance_bins(grid: GridSpec, step_m: float) -> int:
    """Bins of predicted distance on `grid`: the last holds the truncation alone."""
    return math.ceil(grid.truncation_m / step_m - CLOSE) + 1


def bins(
    distance: Field,
    chance: Field | None,
    step_m: float,
    chances: tuple[float, ...],
    count: int,
) -> Ints:
    """The bin of every voxel: of its predicted distance, one of `count`, then of its `corrected`
    probability."""
    found = np.minimum(
        (distance * np.float32(1 / step_m) + np.float32(1e-4)).astype(np.int64), count - 1
    )
    likely: Any = 0 if chance is None else np.searchsorted(np.asarray(chances, np.float32), chance)
    return found * (len(chances) + 1) + likely
