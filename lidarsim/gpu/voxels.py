"""Many scans at once into observed and free voxels: one thread a ray, by the walk of
`lidarsim.voxelize`."""

import sys
from typing import Any

import numpy as np

from lidarsim import voxelize as _function  # noqa: F401 (first: `lidarsim.voxelize` stays it)
from lidarsim.gpu.device import EXACT, on_device, wp
from lidarsim.gpu.translate import translated
from lidarsim.grid import GridSpec
from lidarsim.voxelize import cell_at as cell_at_kernel
from lidarsim.voxelize import clear as clear_kernel

wp.set_module_options(EXACT)
INF = wp.constant(wp.float64(np.inf))
cell_at, clear = translated(cell_at_kernel), translated(clear_kernel)


def voxelize(
    ranges: Any, origins: Any, directions: Any, max_range_m: float, *, grid: GridSpec, corners: Any
) -> tuple[Any, Any]:
    """Sort P scans into grids of their own.

    `ranges` (P, R) are those of `lidarsim.gpu.rays.cast`, rounded here to float32 as in a `Scan`,
    of rays from `origins` (P, 3) along `directions` (P, R, 3). The least corners of the grids are
    `corners` (P, 3), in the world: ``grid.origin_at(origins)`` centres them.

    Returns:
        Observed and free voxels, two Warp arrays (P, *grid.shape) of bool on the device of
        `ranges`. A voxel is free where it is not observed and a ray meets it with positive length.

    Raises:
        ValueError: for arrays of other shapes.
    """
    device, (poses, count) = ranges.device.alias, ranges.shape
    inputs = [
        on_device("ranges", ranges, wp.float64, (poses, count), device),
        on_device("origins", origins, wp.vec3d, (poses,), device),
        on_device("directions", directions, wp.vec3d, (poses, count), device),
        on_device("corners", corners, wp.vec3d, (poses,), device),
        float(max_range_m),
        grid.voxel_m,
        wp.vec3i(*grid.shape),
    ]
    cells = int(np.prod(grid.shape))
    observed, free = (wp.zeros((poses, cells), dtype=wp.bool, device=device) for _ in range(2))
    wp.launch(_clear, dim=ranges.shape, inputs=[*inputs, free], device=device)
    wp.launch(_mark, dim=ranges.shape, inputs=[*inputs, observed, free], device=device)
    return observed.reshape((poses, *grid.shape)), free.reshape((poses, *grid.shape))


@wp.kernel
def _clear(
    ranges: wp.array2d[wp.float64],
    origins: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    corners: wp.array[wp.vec3d],
    max_range_m: wp.float64,
    voxel_m: wp.float64,
    shape: wp.vec3i,
    free: wp.array2d[wp.bool],
) -> None:
    """The voxels on every ray's way."""
    p, n = wp.tid()
    reach = wp.float64(wp.float32(ranges[p, n]))
    end = reach if reach < INF else max_range_m
    o, d, corner = origins[p], directions[p, n], corners[p]
    clear(o, d, end, corner, voxel_m, shape[0], shape[1], shape[2], free[p])


@wp.kernel
def _mark(
    ranges: wp.array2d[wp.float64],
    origins: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    corners: wp.array[wp.vec3d],
    max_range_m: wp.float64,
    voxel_m: wp.float64,
    shape: wp.vec3i,
    observed: wp.array2d[wp.bool],
    free: wp.array2d[wp.bool],
) -> None:
    """The voxels that hold returns."""
    p, n = wp.tid()
    reach = wp.float64(wp.float32(ranges[p, n]))
    if reach < INF:
        o, d, corner = origins[p], directions[p, n], corners[p]
        cell = cell_at(o, d, reach, corner, voxel_m, shape[0], shape[1], shape[2])
        if cell >= 0:
            observed[p, cell] = True
            free[p, cell] = False
