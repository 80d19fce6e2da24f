"""Table I: how near a completion comes to the truth, voxel by voxel."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec
from lidarsim.jit import kernel
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import ReconstructionConfig
from scenegen.model.evaluation.metrics import METRICS, Sums


def measure(
    occupied: NDArray[np.bool_],
    distance: NDArray[np.float32],
    true_occupancy: NDArray[np.bool_],
    true_distance: NDArray[np.float32],
    *,
    classes: NDArray[np.uint8],
    class_count: int,
    config: ReconstructionConfig,
    union: Sequence[int] = (),
) -> NDArray[np.float64]:
    """The metrics of one map, (2 + class_count, len(METRICS)): over the voxels of all classes, over
    those of the classes in `union`, and over each class.

    All grids have the same shape. `classes` holds numbers below `class_count`; a voxel with another
    number, such as `visibility.UNSCORED`, is left out everywhere. A map in which nothing is
    occupied and nothing predicted scores 1 in all four occupancy metrics; otherwise a ratio of
    nothing to nothing is 0. Distance metrics over no voxel are NaN.
    """
    sums = np.zeros((class_count, len(Sums._fields)))
    near = np.float32(config.near_m)
    if config.strict:
        near = np.nextafter(near, np.float32(0))
    said, true = (
        (occupied.reshape(-1), distance.reshape(-1)),
        (true_occupancy.reshape(-1), true_distance.reshape(-1)),
    )
    _accumulate(*said, *true, classes.reshape(-1), near, sums)
    rows = [Sums(*row.tolist()) for row in (sums.sum(axis=0), sums[list(union)].sum(axis=0), *sums)]
    return np.array(
        [[metric.of(row) for metric in METRICS.values()] for row in rows], dtype=np.float64
    )


def measure_whole(
    said: Prediction,
    true_occupancy: NDArray[np.bool_],
    true_distance: NDArray[np.float32],
    grid: GridSpec,
) -> NDArray[np.float64]:
    """The metrics of one map over all its voxels, (len(METRICS),), at the paper's thresholds."""
    at = Thresholds()
    return measure(
        said.occupied(at),
        said.distance(at, grid),
        true_occupancy,
        true_distance,
        classes=np.zeros(grid.shape, np.uint8),
        class_count=1,
        config=ReconstructionConfig(),
    )[0]


@kernel
def _accumulate(occupied, distance, true_occupancy, true_distance, classes, near, sums):
    """Add up, by class, what `Sums` names, in its order."""
    for v in range(len(classes)):
        if classes[v] >= len(sums):
            continue
        row = sums[classes[v]]
        error = float(distance[v]) - float(true_distance[v])
        row[0] += 1.0
        row[1] += error
        row[2] += abs(error)
        row[3] += error * error
        if true_distance[v] <= near:
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
