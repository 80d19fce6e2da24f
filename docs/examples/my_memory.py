"""A method that remembers: the evidence of all scans, which fades; and a robot that flies by it."""

import numpy as np

from scenegen.model.completion.protocol import Extrude
from scenegen.model.robots.mapping import MappingRobot

KEPT = 0.99
"""Share of the evidence that is left after a scan."""
MOST = 5.0
"""The strongest evidence of a voxel."""


def moved(values, voxels):
    """An array in a map that moved by whole `voxels` (3,); 0 where it was not before."""
    result = np.zeros_like(values)
    if (np.abs(voxels) < values.shape).all():
        pairs = list(zip(voxels, values.shape, strict=True))
        here = tuple(slice(max(-step, 0), size - max(step, 0)) for step, size in pairs)
        there = tuple(slice(max(step, 0), size - max(-step, 0)) for step, size in pairs)
        result[here] = values[there]
    return result


class Remembering:
    """Sums up what scans say of each voxel, above 0 for occupied, and extrudes that."""

    name = "remembering"
    learned = False

    def __init__(self):
        self.reset()

    def reset(self):
        """A flight begins, or a map that has nothing to do with the last one."""
        self.evidence, self.origin = None, None

    def complete(self, observed, free, *, grid, seen):
        if self.evidence is None:
            self.evidence, self.origin = np.zeros(grid.shape, np.float32), seen.origin
        voxels = np.rint((seen.origin - self.origin) / grid.voxel_m).astype(int)
        self.evidence = KEPT * moved(self.evidence, voxels) + observed - 0.5 * free
        self.evidence, self.origin = self.evidence.clip(-MOST, MOST), seen.origin
        return Extrude().complete(self.evidence > 0, self.evidence < 0, grid=grid)


class Robot(MappingRobot):
    """Flies by that alone: its own map is of the last scan."""

    def __init__(self):
        super().__init__(Remembering(), memory=False, doubts=True)

    def reset(self, about):
        super().reset(about)
        self.rehearse()  # the first decision takes longer than a robot may think
