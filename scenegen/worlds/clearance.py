"""How far a point or a straight motion stays from the solids of a world: the collision check of the
flights."""

import math
from typing import Any

import numpy as np

from lidarsim.grid import Floats
from lidarsim.jit import kernel
from lidarsim.solids.shapes import Solids
from scenegen.truth.shapes import distance, local
from scenegen.truth.triangles import crossing, joining, triangle_distance

CELL_M = 2.0
"""Edge of the square cells, seen from above, into which solids are sorted."""
MOST_CELLS = 250_000
"""In a box that would hold more, cells are larger."""
CAP_M = 1.0
"""Distances are known exactly up to this; beyond it they count as this."""
STEP_M = 1e-3
"""Shortest step of a motion check, hence how much closer than asked a solid may be between two
steps."""


class Clearance:
    """Distances to the solids of one world within a box.

    Solids are sorted into cells of the plan, so that a query looks at a handful of them only.
    """

    def __init__(self, solids: Solids, bounds: Floats):
        """`bounds` (2, 3): least and greatest corner of where queries will come from, world
        metres."""
        low, high = bounds[0, :2], bounds[1, :2]
        self._low = low
        extent = high - low
        cell_m = max(
            CELL_M, float(np.sqrt(extent.prod() / MOST_CELLS)), float(extent.max()) / MOST_CELLS
        )
        self._cells = np.maximum(np.ceil(extent / cell_m).astype(np.int64), 1)
        corners = solids.triangles
        lower = np.concatenate([solids.lower, corners.min(axis=1)])[:, :2] - CAP_M
        upper = np.concatenate([solids.upper, corners.max(axis=1)])[:, :2] + CAP_M
        first = np.clip(np.floor((lower - low) / cell_m), 0, self._cells).astype(np.int64)
        last = np.clip(np.floor((upper - low) / cell_m), -1, self._cells - 1).astype(np.int64)
        start, item = _sort_into_cells(first, last, self._cells)
        owner = np.repeat(np.arange(len(solids.mesh_filled)), np.diff(solids.mesh_start))
        self._arguments: tuple[Any, ...] = (
            low,
            cell_m,
            self._cells,
            start,
            item,
            solids.shape,
            solids.size,
            solids.position,
            solids.rotation,
            solids.triangles,
            owner,
            solids.mesh_filled,
        )

    @property
    def _kernels(self) -> tuple[Any, Any]:
        """What answers both questions from `_arguments`; kernels cannot be pickled."""
        return _clearance, _motion_is_free

    def at(self, x: float, y: float, z: float) -> float:
        """Distance in metres from a point to the nearest solid, at most `CAP_M`; 0 inside one."""
        return float(self._kernels[0](x, y, z, *self._arguments))

    def motion_is_free(
        self, p: tuple[float, float, float], q: tuple[float, float, float], radius_m: float
    ) -> bool:
        """Whether a ball of `radius_m` (below `CAP_M`) moved straight from `p` to `q` stays clear
        of every solid.

        Walks by the distance still free, which no solid can undercut, in steps of at least
        `STEP_M`.
        """
        return bool(self._kernels[1](p, q, radius_m, self._arguments))


@kernel
def _sort_into_cells(first, last, cells):
    """Compressed rows: item[start[c]:start[c + 1]] are the elements that reach into cell c, in
    rising order."""
    start = np.zeros(cells[0] * cells[1] + 1, np.int64)
    for sweep in range(2):
        if sweep == 1:
            for cell in range(1, len(start)):
                start[cell] += start[cell - 1]
            item = np.empty(start[-1], np.int64)
            filled = start[:-1].copy()
        for n in range(len(first)):
            for i in range(first[n, 0], last[n, 0] + 1):
                for j in range(first[n, 1], last[n, 1] + 1):
                    cell = i * cells[1] + j
                    if sweep == 0:
                        start[cell + 1] += 1
                    else:
                        item[filled[cell]] = n
                        filled[cell] += 1
    return start, item


@kernel
def _clearance(
    x,
    y,
    z,
    low,
    cell_m,
    cells,
    start,
    item,
    shape,
    size,
    position,
    rotation,
    triangles,
    owner,
    filled,
):
    i = min(max(math.floor((x - low[0]) / cell_m), 0), cells[0] - 1)
    j = min(max(math.floor((y - low[1]) / cell_m), 0), cells[1] - 1)
    cell = i * cells[1] + j
    nearest = CAP_M
    mesh, winding = -1, 0
    for at in range(start[cell], start[cell + 1]):
        n = item[at]
        if n < len(shape):
            at_n = position[n]
            dx, dy, dz = local(rotation[n], x - at_n[0], y - at_n[1], z - at_n[2])
            nearest = min(nearest, distance(shape[n], size[n], dx, dy, dz))
        else:
            t = triangles[n - len(shape)]
            m = owner[n - len(shape)]
            nearest = min(nearest, triangle_distance(t[0], t[1], t[2], x, y, z))
            if m != mesh:
                if winding != 0:
                    return 0.0
                mesh, winding = m, 0
            if filled[m]:
                sign, height = crossing(t[0], t[1], t[2], x, y)
                if sign != 0 and height > z:
                    winding += sign
    return 0.0 if winding != 0 else nearest


@kernel
def _motion_is_free(p, q, radius, arguments):
    dx, dy, dz = joining(p, q)
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    # most motions that are refused are so at their ends, many more at their middles; the walk
    # below steps over no point that is nearer than asked by two of its steps
    for s, spare in ((1.0, 0.0), (0.5, 2 * STEP_M)):
        near = _clearance(p[0] + s * dx, p[1] + s * dy, p[2] + s * dz, *arguments)
        if near < radius - spare:
            return False
    t = 0.0
    while True:
        s = min(t / length, 1.0) if length > 0.0 else 1.0
        free = _clearance(p[0] + s * dx, p[1] + s * dy, p[2] + s * dz, *arguments) - radius
        if free < 0.0:
            return False
        if s >= 1.0:
            return True
        t = min(t + max(free, STEP_M), length)
