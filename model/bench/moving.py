"""Occupancy at later times, of datasets with movers: targets, their metrics, and rows of the bench
that say by simple rules how it goes on."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats, GridSpec, Mask, iou
from scenegen.base.errors import MissingPartError
from scenegen.dataset.read import Split
from scenegen.draw.sample import Sample
from scenegen.model.bench.metrics import NAN, Metric, ScoredMap
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import HORIZONS
from scenegen.model.targets import Occupancy
from scenegen.truth import distance_field

NEAR_M = 0.6
"""How near to the way of a mover free voxels count in the IoU of movers, metres."""


class Later(Occupancy):
    """Occupancy some time after the sample's: movers have moved. Outputs are logits."""

    part = ""

    def __init__(self, after_s: float):
        """Fix the time.

        Args:
            after_s: How long after the sample's time, seconds.
        """
        self.after_s, self.end = after_s, f"+{after_s:g}"

    @property
    def metrics(self) -> Mapping[str, Metric]:  # type: ignore[override]
        """IoU over all scored voxels, and over those of them about movers."""
        title, about = f"IoU after {self.after_s:g} s", partial(self.iou, about=True)
        moving = f"{title}, about movers"
        return {
            "iou": Metric(title, self.iou),
            # validation has no samples
            "moving_iou": Metric(moving, about, tested=("map",), bench_only=True),
        }

    def iou(self, scored_map: ScoredMap, *, about: bool = False) -> float:
        """Compute the IoU at that time. The answer of a method that predicts nothing for it is its
        occupancy now.

        Args:
            scored_map: The map and its truth.
            about: Whether only voxels `about_movers` count.

        Returns:
            From 0 to 1; NaN without such voxels.
        """
        name, counted = f"occupancy{self.end}", scored_map.scored
        if about:
            counted = counted & about_movers(scored_map.sample, self.after_s)
        predicted = scored_map.prediction.others.get(name, scored_map.occupied)
        predicted = predicted > np.float32(scored_map.thresholds.probability)
        if not counted.any():
            return NAN
        return iou(predicted[counted], scored_map.truth[name][counted])

    def truth(self, sample: Sample, grid: GridSpec) -> NDArray[Any]:
        """Compute the occupancy at that time.

        Args:
            sample: The sample.
            grid: Its grid; not used.

        Returns:
            Mask (*grid.shape).

        Raises:
            MissingPartError: It has no movers, or courses are not stored for so long.
        """
        return sample.motion.occupancy(self.after_s)


def about_movers(sample: Any, after_s: float) -> Mask:
    """Voxels that a moving mover touches now or at a later time, and those near them that nothing
    which stands occupies: there, who calls too much occupied pays for it.

    Args:
        sample: A sample with movers.
        after_s: Seconds after its time.

    Returns:
        Mask (*grid.shape).
    """
    passed = sample.motion.passed(after_s)
    near = distance_field(passed, sample.grid) <= NEAR_M
    return np.asarray(passed | (near & ~sample.static_occupancy))


OverTime = Callable[[float], Mask]
"""Occupancy (*grid.shape) as a function of the seconds after a sample's time."""


@dataclass(frozen=True)
class Rule:
    """A row that says occupancy now and at later times by a rule."""

    name: str
    rule: Callable[[Sample], OverTime]
    """Of module level, since rows travel to processes."""
    learned: bool = False

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`.

        Args:
            sample: The sample.
            split: Its split; not used.

        Returns:
            Its occupancy now, and at `HORIZONS` as far as courses are stored.

        Raises:
            MissingPartError: The rule needs what the sample lacks.
        """
        later, others = self.rule(sample), dict[str, Mask]()
        with suppress(MissingPartError):
            for name, after_s in HORIZONS.items():
                others[name] = later(after_s)
        return Prediction(later(0.0).astype(np.float32), others=others)


def moved(sample: Sample) -> OverTime:
    """The truth, also at later times: the ceiling."""
    return sample.motion.occupancy


def flow(sample: Any) -> OverTime:
    """The truth now, of which each voxel of a mover goes straight on at its velocity."""
    velocity, moving = sample.motion.flow(), sample.voxel_mover >= 0
    centres, still = sample.grid.centres(sample.origin)[moving], sample.static_occupancy
    return lambda after_s: still | _holding(centres + after_s * velocity[moving], sample)


MOVED, FLOW = (partial(Rule, rule.__name__, rule) for rule in (moved, flow))
"""The rows, made without arguments."""


def _holding(points: Floats, sample: Any) -> Mask:
    """Voxels (*grid.shape) that hold points (n, 3) in the world."""
    held = np.zeros(sample.grid.shape, bool)
    index = sample.grid.index(points, sample.origin)
    held[tuple(index[((index >= 0) & (index < held.shape)).all(axis=1)].T)] = True
    return held
