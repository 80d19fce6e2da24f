"""The voxels of completed maps, counted by what those that are wrong cost."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenegen.model.calibration import denial
from scenegen.model.evaluation.methods import Method
from scenegen.model.evaluation.statistics import brief
from scenegen.model.evaluation.uncertainty import REGIONS, count, reliability
from scenegen.model.evaluation.visibility import CLASSES, UNSCORED, classify, scored_voxels

THRESHOLDS = np.arange(1, 20) / 20
GROUPS = (
    "missed: holds a return",
    "missed: crossed by a ray",
    "missed: hidden, its column holds a return",
    "missed: hidden, its column holds none",
    "missed: inside",
    "missed: out of view, above the sensor",
    "missed: out of view, below it",
    "invented: touches what is there",
    "invented: crossed by a ray",
    "invented: elsewhere",
)
"""What a voxel that is wrong may be: occupied ones by how the scan saw them, see `CLASSES`, and
free ones."""
MISSED = 7
"""How many of them are occupied."""


def counted(seen: Any, split: Any, methods: list[Method]) -> "dict[str, Counts]":
    """The voxels of maps by group, as each method completes them; `seen` holds a sample and its
    groups for each."""
    there = np.array([sums(group) for _, group in seen])
    found = {}
    for method in methods:
        said, sure, denied = [], [], []
        for sample, group in seen:
            guess = method.completion(sample, split)
            probability, calibrated = guess.occupancy_probability, guess.probability
            if probability is None:  # of distances alone, a level for thresholds
                distance_m = guess.distance(None, split.dataset.grid)
                probability = 1 - distance_m / split.dataset.grid.truncation_m
            said.append([sums(group[probability >= threshold]) for threshold in THRESHOLDS])
            weight = getattr(guess.uncertainty, "class_weight", 1.0)
            denied.append(denial(probability, sample.observed, weight))
            readings = [probability] if calibrated is None else [*[probability] * 2, calibrated]
            inside = np.zeros((len(REGIONS), *group.shape), np.bool_)
            inside[0] = group != UNSCORED
            sure.append(count(readings, group < MISSED, inside))
        found[method.name] = Counts(there, np.array(said), np.array(sure), np.array(denied))
    return found


def sums(groups: NDArray[np.uint8]) -> NDArray[np.int64]:
    """How many voxels are of each group."""
    return np.bincount(groups.ravel(), minlength=len(GROUPS))[: len(GROUPS)]


def groups_of(samples: Any, index: int) -> NDArray[np.uint8]:
    """What each voxel (*grid.shape) of a sample would be if it were wrong, an index into `GROUPS`;
    `UNSCORED` where no score counts it."""
    sample, dataset = samples[index], samples.dataset
    seen = classify(sample, lidar=dataset.lidar, grid=dataset.grid)
    is_of = {name: seen == number for number, name in enumerate(CLASSES)}
    told = np.broadcast_to(sample.observed.any(axis=2, keepdims=True), seen.shape)
    above = dataset.grid.centres(sample.origin)[..., 2] > sample.position[2]
    hidden, out = is_of["occluded"], is_of["out_of_view"]
    missed = [is_of["observed"], is_of["crossed"], hidden & told, hidden, is_of["interior"]]
    beside = ndimage.binary_dilation(sample.occupancy, np.ones((3, 3, 3)))
    groups = np.where(
        sample.occupancy,
        np.select([*missed, out & above], range(MISSED - 1), MISSED - 1),
        np.select([beside, is_of["crossed"]], (MISSED, MISSED + 1), MISSED + 2),
    )
    scored_here = scored_voxels(sample, dataset.grid, samples.home(index).tables)
    return np.where(scored_here, groups, UNSCORED).astype(np.uint8)


class Counts(NamedTuple):
    """Voxels of some maps by group."""

    there: NDArray[np.int64]
    """(maps, groups)."""
    said: NDArray[np.int64]
    """(maps, thresholds, groups): those that are said to be occupied."""
    sure: NDArray[np.float64]
    """Of each map, what `count` counts over the voxels that are scored."""
    denied: NDArray[np.float64]
    """Of each map, the share of its returns that is denied; see `denial`."""

    @property
    def either(self) -> NDArray[np.int64]:
        """(maps, thresholds): voxels that are occupied, or said to be."""
        return self.there[:, None, :MISSED].sum(axis=2) + self.said[..., MISSED:].sum(axis=2)

    @property
    def iou(self) -> NDArray[np.float64]:
        """(maps, thresholds)."""
        return self.said[..., :MISSED].sum(axis=2) / np.maximum(self.either, 1)

    @property
    def ece(self) -> str:
        """The expected calibration error as predicted, and calibrated where the method can."""
        found = reliability(self.sure, np.arange(len(self.sure)))["map"]
        cells = [brief(one | {"mean": one["ece"], "n": 1}) for one in found.values()]
        return " → ".join(cells[::2])

    def size(self, group: int) -> float:
        """The share of a group in what is occupied."""
        return float(self.there[:, group].sum() / self.there[:, :MISSED].sum())

    def share(self, group: int, threshold: int) -> tuple[float, float]:
        """The points of IoU that a group costs, a mean over maps, and its recall."""
        said = self.said[:, threshold, group]
        wrong = self.there[:, group] - said if group < MISSED else said
        lost = 100 * (wrong / np.maximum(self.either[:, threshold], 1)).mean()
        return float(lost), float(said.sum() / max(self.there[:, group].sum(), 1))
