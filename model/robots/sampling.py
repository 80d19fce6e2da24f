"""A robot that plans by sampling, as many vehicles do: informed RRT* instead of A*."""

import math
from typing import Any

import numpy as np
from ompl import geometric as og
from scipy import ndimage

from lidarsim.grid import Floats, Ints, Mask, Vector
from lidarsim.jit import kernel
from scenegen.model.bench.trials import RATHER
from scenegen.model.robots.mapping import PLAN, MappingRobot
from scenegen.worlds.flight import FlightConfig, connect, points_of

SEARCH = FlightConfig(iterations=800, step_m=3.0, goal_tolerance_m=0.2)
"""How many points are drawn for a path, its longest edge, and how near to the goal it ends."""


class SamplingRobot(MappingRobot):
    """A `MappingRobot` that plans by informed RRT* (Gammell, Srinivasa, Barfoot 2014).

    It searches the shortest path through the voxels that A* could use, too. Of these it avoids all
    that are rather occupied than not, if there is a way without them. A* weighs every risk.
    """

    def _searched(self, blocked: Mask, first: Ints, shape: Ints, begin: Ints, node: Ints) -> Floats:
        """See `MappingRobot._searched`."""
        ends = first + PLAN.step_voxels * np.stack([begin, node])
        blocked = blocked.copy()
        blocked[tuple(slice(max(at - 1, 0), at + 2) for at in ends[0])] = False
        voxel_m = self.grid.voxel_m
        for closed in (blocked | (self._risk > RATHER), blocked):
            # RRT* cannot tell that there is no path, and would draw points in vain
            closed[tuple(ends[0])] = False
            parts, _ = ndimage.label(~closed)
            start, goal = parts[tuple(ends.T)]
            if start == goal:
                break
        else:
            return np.empty((0, 3))
        motions: Any = _Motions(closed, voxel_m)
        bounds = np.stack([np.zeros(3), voxel_m * np.array(closed.shape)])
        points = (ends[0] + 0.5) * voxel_m, (ends[1] + 0.5) * voxel_m
        seed = int(self._rng.integers(1, 2**31))
        solution = connect(motions, bounds, SEARCH, points, seed, og.InformedRRTstar)
        if solution is None:
            return np.empty((0, 3))
        path = points_of(solution[1])
        legs = np.diff(path, axis=0)
        ends_m = np.append(0.0, np.cumsum(np.sqrt((legs * legs).sum(axis=1))))
        # as dense as the lattice's paths, for the refinement
        count = math.ceil(ends_m[-1] / (PLAN.step_voxels * voxel_m)) + 1
        along = np.linspace(0.0, ends_m[-1], max(count, 2))
        return np.stack([np.interp(along, ends_m, axis) for axis in path.T], axis=1)


class _Motions:
    """OMPL's edge check on voxels: as `scenegen.worlds.clearance.Clearance` has it for solids."""

    def __init__(self, closed: Mask, voxel_m: float):
        self._closed, self._voxel_m = closed, voxel_m

    def motion_is_free(self, p: Vector, q: Vector, radius_m: float) -> bool:
        """Test whether a straight line meets no closed voxel, at points half a voxel apart.

        Args:
            p: Its start (3,), metres from the fence's least corner.
            q: Its end (3,).
            radius_m: Not needed: closed voxels are as much larger.
        """
        return bool(_is_free(self._closed, self._voxel_m, p, q))


@kernel
def _is_free(closed, voxel_m, p, q):
    nx, ny, nz = closed.shape
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    count = int(2.0 * math.sqrt(dx * dx + dy * dy + dz * dz) / voxel_m) + 1
    for n in range(1, count + 1):
        share = n / count
        # a point of the outermost face belongs to the last voxel
        x = min(int((p[0] + share * dx) / voxel_m), nx - 1)
        y = min(int((p[1] + share * dy) / voxel_m), ny - 1)
        z = min(int((p[2] + share * dz) / voxel_m), nz - 1)
        if closed[x, y, z]:
            return False
    return True
