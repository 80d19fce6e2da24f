"""Every metric once; and reconstruction: how near a completion comes to the truth, voxel by voxel
(Table I).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Field, Floats, Mask
from lidarsim.jit import kernel
from scenegen.model.bench.statistics import Scale
from scenegen.model.config import NEAR_M

NAN = float("nan")


class Sums(NamedTuple):
    """Sums over some voxels of one map; errors are predicted less true distances, metres."""

    voxels: float
    """Voxels whose true distance is certain: the sums of errors, and those of voxels near an
    obstacle, are over these alone; hits, alarms and misses are over all."""
    error: float
    size: float
    """Absolute errors."""
    square: float
    near: float
    """Voxels near an obstacle; the next three are over these alone."""
    near_error: float
    near_size: float
    near_square: float
    hits: float
    """Voxels that are occupied and predicted to be."""
    alarms: float
    """Voxels that are predicted to be occupied, and are not."""
    misses: float
    """Voxels that are occupied, and not predicted to be."""

    def share(self, part: float, whole: float) -> float:
        """`part` of `whole`; 0 of nothing, and 1 where nothing is occupied and nothing
        predicted."""
        nothing = self.hits + self.alarms + self.misses == 0
        return 1.0 if nothing else part / whole if whole else 0.0


def _mean(total: float, count: float) -> float:
    return total / count if count else NAN


@dataclass(frozen=True)
class Metric:
    """One figure of a map, or of a trial."""

    title: str
    """What people call it."""
    of: Callable[[Any], float]
    """Its value for a map's `Sums`, or for a trial's `Measurement`; NaN where there is nothing to
    measure."""
    needs: Literal["distance", "occupancy", "trial", "path"]
    """Which part of a prediction it judges; or whether trials without a path have a value, too, or
    only those that found one."""
    better: Literal["higher", "lower", "nearer to 0"] = "higher"
    unit: str = ""
    tested: tuple[Literal["map", "unobserved", "unmarked"], ...] = ()
    """Where methods are compared in pairs by it: over the voxels of the whole map, or the unknown
    ones; in planning, "map" means all trials, "unmarked" the trials of `MethodResult.unmarked`."""

    @property
    def label(self) -> str:
        """Title and unit."""
        return ", ".join(filter(None, (self.title, self.unit)))

    @property
    def scale(self) -> Scale:
        """What its values are."""
        return "outcome" if self.needs == "trial" else "amount" if self.unit else "share"


METRICS = {
    "rmse": Metric("RMSE", lambda s: _mean(s.square, s.voxels) ** 0.5, "distance", "lower", "m"),
    "mae": Metric("MAE", lambda s: _mean(s.size, s.voxels), "distance", "lower", "m"),
    "near_rmse": Metric(
        "Near-RMSE",
        lambda s: _mean(s.near_square, s.near) ** 0.5,
        "distance",
        "lower",
        "m",
        tested=("map",),
    ),
    "near_mae": Metric(
        "Near-MAE",
        lambda s: _mean(s.near_size, s.near),
        "distance",
        "lower",
        "m",
        tested=("map",),
    ),
    "bias": Metric("bias", lambda s: _mean(s.error, s.voxels), "distance", "nearer to 0", "m"),
    "near_bias": Metric(
        "Near-bias", lambda s: _mean(s.near_error, s.near), "distance", "nearer to 0", "m"
    ),
    "iou": Metric(
        "IoU",
        lambda s: s.share(s.hits, s.hits + s.alarms + s.misses),
        "occupancy",
        tested=("map", "unobserved"),
    ),
    "f1": Metric(
        "F1",
        lambda s: s.share(2 * s.hits, 2 * s.hits + s.alarms + s.misses),
        "occupancy",
        tested=("map",),
    ),
    "precision": Metric("precision", lambda s: s.share(s.hits, s.hits + s.alarms), "occupancy"),
    "recall": Metric("recall", lambda s: s.share(s.hits, s.hits + s.misses), "occupancy"),
}
"""Reconstruction: the paper's ten, section "Quantitative Reconstruction Results"."""
PLAN_METRICS = {
    "success_blocked": Metric(
        "success, blocked line",
        lambda trial: trial.success if trial.line_blocked else NAN,
        "trial",
        tested=("map",),
    ),
    "success": Metric("success", lambda trial: trial.success, "trial", tested=("map",)),
    "hits": Metric(
        "hits", lambda trial: trial.hits_obstacle, "trial", "lower", tested=("unmarked",)
    ),
    "crossed_hits": Metric(
        "hits in crossed voxels only", lambda trial: trial.hits_crossed_only, "trial", "lower"
    ),
    "length": Metric("length", lambda trial: trial.length_m, "path", "lower", "m"),
    "min_clearance": Metric(
        "least clearance", lambda trial: trial.min_clearance_m, "path", unit="m"
    ),
    "avg_clearance": Metric(
        "mean clearance", lambda trial: trial.mean_clearance_m, "path", unit="m"
    ),
}
"""Planning: success, length and clearances are the paper's, section "Planning with Predicted
Distance Fields"; the first leads the tables, and `hits` those of maps of real places."""


def measure(
    occupied: Mask,
    distance: Field,
    true_occupancy: Mask,
    true_distance: Field,
    *,
    classes: NDArray[np.uint8],
    class_count: int,
    union: Sequence[int] = (),
    certain: Mask | None = None,
) -> Floats:
    """The metrics of one map, (2 + class_count, len(METRICS)): over the voxels of all classes, over
    those of the classes in `union`, and over each class.

    All grids have the same shape. Voxels are near an obstacle at `NEAR_M` metres or less. `classes`
    holds numbers below `class_count`; a voxel with another number, such as `visibility.UNSCORED`,
    is left out everywhere. Distances count where they are `certain` (*grid.shape), everywhere by
    default. A map in which nothing is occupied and nothing predicted scores 1 in all four occupancy
    metrics; otherwise a ratio of nothing to nothing is 0. Distance metrics over no voxel are NaN.
    """
    sums = np.zeros((class_count, len(Sums._fields)))
    sure = np.ones(classes.shape, bool) if certain is None else certain
    grids = (occupied, distance, true_occupancy, true_distance, classes, sure)
    _accumulate(*(*(grid.reshape(-1) for grid in grids), sums))
    rows = [Sums(*row.tolist()) for row in (sums.sum(axis=0), sums[list(union)].sum(axis=0), *sums)]
    return np.array([[metric.of(row) for metric in METRICS.values()] for row in rows], float)


@kernel
def _accumulate(occupied, distance, true_occupancy, true_distance, classes, certain, sums):
    """Add up, by class, what `Sums` names, in its order: a new sum goes to the end of both."""
    for v in range(len(classes)):
        if classes[v] >= len(sums):
            continue
        row = sums[classes[v]]
        error = float(distance[v]) - float(true_distance[v])
        if certain[v]:
            row[0] += 1.0
            row[1] += error
            row[2] += abs(error)
            row[3] += error * error
        if certain[v] and true_distance[v] <= NEAR_M:
            row[4] += 1.0
            row[5] += error
            row[6] += abs(error)
            row[7] += error * error
        if occupied[v]:
            if true_occupancy[v]:
                row[8] += 1.0
            else:
                row[9] += 1.0
        elif true_occupancy[v]:
            row[10] += 1.0
