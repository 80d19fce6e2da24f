"""Whose a voxel is: the solid that holds its centre, or else the nearest one."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import Floats, GridSpec, Mask
from lidarsim.jit import kernel
from lidarsim.solids.shapes import Solids
from scenegen.truth.occupancy import SLACK_M, spans
from scenegen.truth.shapes import distance, local
from scenegen.truth.triangles import inside_columns, triangle_distance

NONE = -1
"""The owner of a voxel that is not occupied."""


def owners(solids: Solids, occupancy: Mask, grid: GridSpec, origin: ArrayLike) -> NDArray[np.int32]:
    """The geom (*grid.shape) that every occupied voxel belongs to, `NONE` elsewhere; `origin` (3,)
    is the grid's least corner, world metres.

    It is the geom whose filled solid lies nearest to the voxel's centre, at 0 where it holds the
    centre; of several at the same distance the one with the lowest number.
    """
    origin, voxel_m = np.asarray(origin, dtype=np.float64), grid.voxel_m
    reach = (
        0.5 * math.sqrt(3.0) * voxel_m + 2 * SLACK_M
    )  # a cube that a solid touches has its centre no farther off
    nearest, owner = np.full(grid.shape, np.inf), np.full(grid.shape, NONE, np.int32)
    primitives = len(solids.shape)
    for n in range(primitives):
        cells = _cells(solids.lower[n] - reach, solids.upper[n] + reach, origin, grid)
        if cells is not None:
            here = np.where(occupancy[cells], 0.0, np.inf)
            first = np.array([part.start for part in cells])
            _to_primitive(
                solids.shape[n],
                solids.size[n],
                solids.position[n],
                solids.rotation[n],
                origin + (first + 0.5) * voxel_m,
                voxel_m,
                here,
            )
            _claim(here, int(solids.geom[n]), nearest[cells], owner[cells])
    for mesh, filled in enumerate(solids.mesh_filled):
        triangles = solids.triangles[solids.mesh_start[mesh] : solids.mesh_start[mesh + 1]]
        low, high = triangles.min(axis=1) - reach, triangles.max(axis=1) + reach
        cells = _cells(low.min(axis=0), high.max(axis=0), origin, grid)
        if cells is not None:
            here = np.full(grid.shape, np.inf)
            _to_triangles(triangles, low, high, origin, voxel_m, occupancy, here)
            if filled:
                held = np.zeros(grid.shape, np.bool_)
                inside_columns(triangles, origin, voxel_m, held)
                here[held & occupancy] = 0.0
            _claim(here[cells], int(solids.geom[primitives + mesh]), nearest[cells], owner[cells])
    return owner


def _cells(
    lower: Floats,
    upper: Floats,
    origin: Floats,
    grid: GridSpec,
) -> tuple[slice, ...] | None:
    """The voxels that touch a box; None where there are none."""
    ends = spans(lower, upper, origin, grid.voxel_m, grid.shape)
    found = tuple(map(slice, ends[::2], ends[1::2]))
    return found if all(part.start < part.stop for part in found) else None


def _claim(here: Floats, geom: int, nearest: Floats, owner: NDArray[np.int32]) -> None:
    """Give `geom` the voxels to which it is nearer than their owner, or as near and of a lower
    number."""
    won = (here < nearest) | ((here == nearest) & np.isfinite(here) & (geom < owner))
    nearest[won], owner[won] = here[won], geom


@kernel
def _to_primitive(shape, size, position, axes, first, voxel_m, here):
    """Distances of centres to a primitive, where `here` is not inf."""
    nx, ny, nz = here.shape
    for i in range(nx):
        dx = first[0] + i * voxel_m - position[0]
        for j in range(ny):
            dy = first[1] + j * voxel_m - position[1]
            for k in range(nz):
                if here[i, j, k] == 0.0:
                    dz = first[2] + k * voxel_m - position[2]
                    x, y, z = local(axes, dx, dy, dz)
                    here[i, j, k] = distance(shape, size, x, y, z)


@kernel
def _to_triangles(triangles, low, high, origin, voxel_m, occupancy, here):
    """Least distances of occupied voxels' centres to triangles (T, 3, 3), in boxes from `low` to
    `high` (T, 3)."""
    for n in range(len(triangles)):
        a, b, c = triangles[n, 0], triangles[n, 1], triangles[n, 2]
        i0, i1, j0, j1, k0, k1 = spans(low[n], high[n], origin, voxel_m, occupancy.shape)
        for i in range(i0, i1):
            x = origin[0] + (i + 0.5) * voxel_m
            for j in range(j0, j1):
                y = origin[1] + (j + 0.5) * voxel_m
                for k in range(k0, k1):
                    if occupancy[i, j, k]:
                        z = origin[2] + (k + 0.5) * voxel_m
                        here[i, j, k] = min(here[i, j, k], triangle_distance(a, b, c, x, y, z))
