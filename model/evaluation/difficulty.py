"""How hard a map is, told from the truth and the scan alone."""

import numpy as np
from scipy import ndimage

from lidarsim import GridSpec
from scenegen.model.evaluation.config import PlanConfig
from scenegen.model.evaluation.planning.astar import Lattice
from scenegen.sample import Sample

DESCRIPTORS = ("gap_m", "traversable", "hidden")
"""gap_m: twice the median distance to solids on the ridges between them, metres · traversable:
share of the planner's lattice that can be reached from the sensor in the truth · hidden: share of
the occupied voxels that hold no return."""


def describe(sample: Sample, *, grid: GridSpec, config: PlanConfig) -> np.ndarray:
    """The descriptors of one sample, (len(DESCRIPTORS),); NaN where there is nothing to measure."""
    occupied = np.count_nonzero(sample.occupancy)
    hidden = 1 - np.count_nonzero(sample.observed) / occupied if occupied else np.nan
    return np.array([_gap(sample, grid), _traversable(sample, grid, config), hidden])


def _gap(sample: Sample, grid: GridSpec) -> float:
    """A ridge voxel is free, nearer than the truncation, no nearer to solids than its six
    neighbours are, and not at the map's border, beyond which nothing is known."""
    field = sample.tudf
    ridge = (field > 0) & (field < np.float32(grid.truncation_m))
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        here, there = tuple(behind), tuple(ahead)
        ridge[here] &= field[here] >= field[there]
        ridge[there] &= field[there] >= field[here]
    field, ridge = field[1:-1, 1:-1, 1:-1], ridge[1:-1, 1:-1, 1:-1]
    return float(2 * np.median(field[ridge])) if ridge.any() else float("nan")


def _traversable(sample: Sample, grid: GridSpec, config: PlanConfig) -> float:
    """Nodes in the start's connected component, of all nodes; 0 where the start is blocked."""
    lattice = Lattice(grid, config.step_voxels)
    nodes = np.indices(lattice.shape).reshape(3, -1).T
    free = ~sample.occupancy[tuple(lattice.voxels(nodes).T)].reshape(lattice.shape)
    parts, _ = ndimage.label(free, structure=np.ones((3, 3, 3)))
    start = parts[tuple(lattice.start)]
    return float((parts == start).mean()) if start else 0.0
