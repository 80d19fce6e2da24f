"""Whose a voxel is: the solid that holds its centre, or else the nearest one."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import GridSpec
from lidarsim.jit import kernel
from lidarsim.solids.shapes import Solids
from scenegen.truth.occupancy import SLACK_M
from scenegen.truth.shapes import distance
from scenegen.truth.triangles import inside_columns, triangle_distance

NONE = -1
"""The owner of a voxel that is not occupied."""


def owners(
    solids: Solids, occupancy: NDArray[np.bool_], grid: GridSpec, origin: ArrayLike
) -> NDArray[np.int32]:
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
        cells = _cells(solids.lower[n], solids.upper[n], reach, origin, grid)
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
        corners = triangles.reshape(-1, 3)
        cells = _cells(corners.min(axis=0), corners.max(axis=0), reach, origin, grid)
        if cells is not None:
            here = np.full(grid.shape, np.inf)
            _to_triangles(triangles, reach, origin, voxel_m, occupancy, here)
            if filled:
                held = np.zeros(grid.shape, np.bool_)
                inside_columns(triangles, origin, voxel_m, held)
                here[held & occupancy] = 0.0
            _claim(here[cells], int(solids.geom[primitives + mesh]), nearest[cells], owner[cells])
    return owner


def _cells(
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    reach: float,
    origin: NDArray[np.float64],
    grid: GridSpec,
) -> tuple[slice, ...] | None:
    """The voxels whose centres lie within `reach` of a box, and one more on each side; None where
    there are none."""
    low = np.clip((lower - reach - origin) / grid.voxel_m - 1.5, 0, grid.shape)
    high = np.clip((upper + reach - origin) / grid.voxel_m + 1.5, 0, grid.shape)
    found = tuple(
        slice(int(a), math.ceil(b)) for a, b in zip(low.tolist(), high.tolist(), strict=True)
    )
    return found if all(part.start < part.stop for part in found) else None


def _claim(
    here: NDArray[np.float64], geom: int, nearest: NDArray[np.float64], owner: NDArray[np.int32]
) -> None:
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
                    here[i, j, k] = distance(
                        shape,
                        size,
                        axes[0, 0] * dx + axes[1, 0] * dy + axes[2, 0] * dz,
                        axes[0, 1] * dx + axes[1, 1] * dy + axes[2, 1] * dz,
                        axes[0, 2] * dx + axes[1, 2] * dy + axes[2, 2] * dz,
                    )


@kernel
def _to_triangles(triangles, reach, origin, voxel_m, occupancy, here):
    """Least distances of occupied voxels' centres to triangles (T, 3, 3), where they are within
    `reach` or so."""
    nx, ny, nz = occupancy.shape
    for n in range(len(triangles)):
        a, b, c = triangles[n, 0], triangles[n, 1], triangles[n, 2]
        i0 = int(min(max((min(a[0], b[0], c[0]) - reach - origin[0]) / voxel_m - 1.5, 0.0), nx))
        j0 = int(min(max((min(a[1], b[1], c[1]) - reach - origin[1]) / voxel_m - 1.5, 0.0), ny))
        k0 = int(min(max((min(a[2], b[2], c[2]) - reach - origin[2]) / voxel_m - 1.5, 0.0), nz))
        i1 = math.ceil(
            min(max((max(a[0], b[0], c[0]) + reach - origin[0]) / voxel_m + 1.5, 0.0), nx)
        )
        j1 = math.ceil(
            min(max((max(a[1], b[1], c[1]) + reach - origin[1]) / voxel_m + 1.5, 0.0), ny)
        )
        k1 = math.ceil(
            min(max((max(a[2], b[2], c[2]) + reach - origin[2]) / voxel_m + 1.5, 0.0), nz)
        )
        for i in range(i0, i1):
            x = origin[0] + (i + 0.5) * voxel_m
            for j in range(j0, j1):
                y = origin[1] + (j + 0.5) * voxel_m
                for k in range(k0, k1):
                    if occupancy[i, j, k]:
                        z = origin[2] + (k + 0.5) * voxel_m
                        here[i, j, k] = min(here[i, j, k], triangle_distance(a, b, c, x, y, z))
