"""Many scans at once into observed and free voxels: one thread a ray, `lidarsim.voxelize` again in
Warp."""

from typing import Any

import numpy as np

from lidarsim import voxelize as _function  # noqa: F401 (asked for first: `lidarsim.voxelize` stays the function)
from lidarsim.gpu.device import EXACT, on_device, placed, wp
from lidarsim.grid import GridSpec
from lidarsim.voxelize import TOUCH_M

wp.set_module_options(EXACT)
INF = wp.constant(wp.float64(np.inf))
ZERO = wp.constant(wp.float64(0.0))
TOUCH = wp.constant(wp.float64(TOUCH_M))


def voxelize(
    ranges: Any, origins: Any, directions: Any, max_range_m: float, *, grid: GridSpec, corners: Any
) -> tuple[Any, Any]:
    """Observed and free voxels of P scans, two Warp arrays (P, *grid.shape) of bool on the device
    of `ranges`.

    `ranges` (P, R) are those of `lidarsim.gpu.rays.cast`, rounded here to float32 as in a `Scan`,
    of rays from `origins` (P, 3) along `directions` (P, R, 3). The least corners of the grids are
    `corners` (P, 3), in the world: ``grid.origin_at(origins)`` centres them. A voxel is free where
    it is not observed and a ray meets it with positive length. Raises ValueError for arrays of
    other shapes.
    """
    device = ranges.device.alias
    poses, count = ranges.shape
    starts, lows, rays = (
        on_device(values, wp.vec3d, device) for values in (origins, corners, directions)
    )
    placed("ranges", ranges, (poses, count), wp.float64, device)
    placed("origins", starts, (poses,), wp.vec3d, device)
    placed("corners", lows, (poses,), wp.vec3d, device)
    placed("directions", rays, (poses, count), wp.vec3d, device)
    observed, free = (
        wp.zeros((poses, *grid.shape), dtype=wp.bool, device=device) for _ in range(2)
    )
    scans = [ranges, starts, rays, lows, grid.voxel_m]
    wp.launch(_clear, dim=ranges.shape, inputs=[*scans, max_range_m, free], device=device)
    wp.launch(_mark, dim=ranges.shape, inputs=[*scans, observed, free], device=device)
    return observed, free


@wp.kernel
def _mark(
    ranges: wp.array2d[wp.float64],
    origins: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    corners: wp.array[wp.vec3d],
    voxel_m: wp.float64,
    observed: wp.array4d[wp.bool],
    free: wp.array4d[wp.bool],
) -> None:
    """The voxels that hold returns."""
    p, n = wp.tid()
    reach = wp.float64(wp.float32(ranges[p, n]))
    if reach < INF:
        at = (origins[p] + reach * directions[p, n] - corners[p]) / voxel_m
        x, y, z = wp.floor(at[0]), wp.floor(at[1]), wp.floor(at[2])
        if _in(x, free.shape[1]) and _in(y, free.shape[2]) and _in(z, free.shape[3]):
            observed[p, wp.int32(x), wp.int32(y), wp.int32(z)] = True
            free[p, wp.int32(x), wp.int32(y), wp.int32(z)] = False


@wp.func
def _in(at: wp.float64, count: wp.int32) -> wp.bool:
    """Whether a voxel's number, or a place counted in voxels, is within the grid along one axis."""
    return at >= ZERO and at < wp.float64(count)


@wp.kernel
def _clear(
    ranges: wp.array2d[wp.float64],
    origins: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    corners: wp.array[wp.vec3d],
    voxel_m: wp.float64,
    max_range_m: wp.float64,
    free: wp.array4d[wp.bool],
) -> None:
    """The voxels on every ray's way, walked from boundary to boundary (Amanatides and Woo 1987).

    Every crossing is computed from its boundary's own number, never by adding up steps, so that
    errors do not grow.
    """
    p, n = wp.tid()
    d = directions[p, n]
    start = (origins[p] - corners[p]) / voxel_m
    reach = wp.float64(wp.float32(ranges[p, n]))
    t = wp.float64(ZERO)
    leave = reach if reach < INF else max_range_m
    pace = wp.vec3d()  # metres of ray per voxel; 0 for a ray that stands still along the axis
    for axis in range(3):
        count = free.shape[axis + 1]
        if d[axis] != ZERO:
            pace[axis] = voxel_m / d[axis]
            one, other = -start[axis] * pace[axis], (wp.float64(count) - start[axis]) * pace[axis]
            t = wp.max(t, wp.min(one, other))
            leave = wp.min(leave, wp.max(one, other))
        elif not _in(start[axis], count):
            leave = -INF
    if not leave - t > TOUCH:
        return
    cell, ahead, crossing = wp.vec3i(), wp.vec3d(), wp.vec3d(INF)
    for axis in range(3):
        place = wp.floor(start[axis])
        if pace[axis] != ZERO:
            place = wp.floor(start[axis] + t / pace[axis])
            place = wp.min(wp.max(place, ZERO), wp.float64(free.shape[axis + 1] - 1))
            ahead[axis] = place + wp.max(wp.sign(pace[axis]), ZERO)
            crossing[axis] = (ahead[axis] - start[axis]) * pace[axis]
        cell[axis] = wp.int32(place)
    going = wp.bool(True)
    while going:
        axis = 2
        if crossing[0] < crossing[1]:
            if crossing[0] < crossing[2]:
                axis = 0
        elif crossing[1] < crossing[2]:
            axis = 1
        at = wp.min(crossing[axis], leave)
        if at - t > TOUCH:
            free[p, cell[0], cell[1], cell[2]] = True
            t = at
        going = at < leave
        forward = wp.sign(pace[axis])
        ahead[axis] += forward
        crossing[axis] = (ahead[axis] - start[axis]) * pace[axis]
        cell[axis] += wp.int32(forward)
