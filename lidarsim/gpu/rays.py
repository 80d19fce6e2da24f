"""Rays through many worlds at once, and the voxels that they meet: one thread a ray.

What a thread does is what the analytic engine and `lidarsim.voxelize` do, by their own functions.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.engines import forms, traverse
from lidarsim.gpu.translate import translated
from lidarsim.gpu.worlds import EXACT, Packed, Worlds, on_device, wp
from lidarsim.grid import GridSpec
from lidarsim.solids.shapes import PLANE
from lidarsim.voxelization import cell_at, clear

wp.set_module_options(EXACT)
INF = wp.constant(wp.float64(np.inf))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
SPARE = wp.constant(wp.float64(traverse.SPARE_LENGTH2))
ROUNDED = wp.constant(wp.float64(traverse.ROUNDED))
inverse = translated(traverse.inverse)
passes = translated(traverse.passes)
meet_solid = translated(traverse.meet_solid)
meet_plane = translated(forms.meet_plane)
upright = translated(forms.upright)
meet_triangle = translated(forms.meet_triangle)
clear_voxels = translated(clear)
voxel_at = translated(cell_at)


def cast(
    worlds: Worlds,
    origins: Any,
    directions: Any,
    max_range_m: float,
    *,
    which: ArrayLike | None = None,
) -> Any:
    """Cast rays from poses in worlds of their own.

    A ray that is no unit vector, or whose origin is not finite, meets nothing.

    Args:
        worlds: the worlds, on a device.
        origins: (P, 3), where the poses stand: NumPy's array, or Warp's (P,) of ``vec3d``.
        directions: (P, R, 3), unit vectors in the world: NumPy's array, or Warp's (P, R).
        max_range_m: beyond, nothing is met.
        which: (P,), the world of each pose; pose p stands in world p unless it is given.

    Returns:
        Metres along the rays to the first surface, a Warp array (P, R) of float64 on the worlds'
        device; ``inf`` where nothing is met.

    Raises:
        ValueError: for arrays of other shapes.
    """
    poses, count = (*np.shape(directions), 0, 0)[:2]
    starts = on_device("origins", origins, wp.vec3d, (poses,), worlds.device)
    rays = on_device("directions", directions, wp.vec3d, (poses, count), worlds.device)
    ranges = wp.empty((poses, count), dtype=wp.float64, device=worlds.device)
    inputs = [worlds.packed, worlds.which(which, poses), starts, rays, float(max_range_m), ranges]
    wp.launch(_cast, dim=ranges.shape, inputs=inputs, device=worlds.device)
    return ranges


@wp.kernel
def _cast(
    packed: Packed,
    which: wp.array[wp.int32],
    origins: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    max_range_m: wp.float64,
    ranges: wp.array2d[wp.float64],
) -> None:
    p, n = wp.tid()
    o, d = origins[p], wp.vec3d(directions[p, n])
    best = wp.float64(max_range_m)
    met = wp.bool(False)
    box = wp.int32(packed.box_start[which[p]])
    end = wp.int32(packed.box_start[which[p] + 1])
    length2 = wp.dot(d, d)
    if not (wp.abs(length2 - ONE) <= SPARE and wp.abs(o[0]) + wp.abs(o[1]) + wp.abs(o[2]) < INF):
        box = end
    if wp.abs(length2 - ONE) > ROUNDED:
        d /= wp.sqrt(length2)
    steps = wp.vec3d(inverse(d[0]), inverse(d[1]), inverse(d[2]))
    frame = upright(o, d)
    while box < end:
        one = wp.cw_mul(packed.box_lower[box] - o, steps)
        other = wp.cw_mul(packed.box_upper[box] - o, steps)
        near, far = wp.min(one, other), wp.max(one, other)
        begin = wp.max(wp.max(near[0], near[1]), wp.max(near[2], ZERO))
        if begin > wp.min(wp.min(far[0], far[1]), wp.min(far[2], best)):
            box = packed.beyond[box]
            continue
        for q in range(packed.first[box], packed.last[box]):
            t = _meet_item(packed, packed.item[q], o, d, frame)
            if t <= best and t < INF:
                best = t
                met = True
        box += 1
    ranges[p, n] = best if met else INF


@wp.func
def _meet_item(packed: Packed, g: wp.int32, o: wp.vec3d, d: wp.vec3d, frame: Any) -> wp.float64:
    """Distance to a primitive of the world, or to a triangle."""
    if g < 0:
        return meet_triangle(packed.triangles, -1 - g, frame)
    x = o[0] - packed.position[g, 0]
    y = o[1] - packed.position[g, 1]
    z = o[2] - packed.position[g, 2]
    if packed.shape[g] == PLANE:
        return meet_plane(g, packed.size, packed.rotation, x, y, z, d[0], d[1], d[2])
    if passes(packed.reach2[g], x, y, z, d[0], d[1], d[2]):
        return INF
    return meet_solid(g, packed.shape, packed.size, packed.rotation, x, y, z, d[0], d[1], d[2])


def voxelize(
    ranges: Any, origins: Any, directions: Any, max_range_m: float, *, grid: GridSpec, corners: Any
) -> tuple[Any, Any]:
    """Sort P scans into grids of their own.

    Args:
        ranges: (P, R) of `cast`, rounded here to float32 as in a `Scan`.
        origins: (P, 3), as for `cast`.
        directions: (P, R, 3), as for `cast`.
        max_range_m: how far a ray without a return clears voxels.
        grid: voxels and their size.
        corners: (P, 3), the least corners of the grids in the world, metres:
            ``grid.origin_at(origins)`` centres them.

    Returns:
        Observed and free voxels, two Warp arrays (P, *grid.shape) of bool on the device of
        `ranges`. A voxel is free where it is not observed and a ray meets it with positive length.

    Raises:
        ValueError: for arrays of other shapes.
    """
    device, (poses, count) = ranges.device.alias, ranges.shape
    scans = [
        on_device("ranges", ranges, wp.float64, (poses, count), device),
        on_device("origins", origins, wp.vec3d, (poses,), device),
        on_device("directions", directions, wp.vec3d, (poses, count), device),
        on_device("corners", corners, wp.vec3d, (poses,), device),
        wp.vec3i(*grid.shape),
        grid.voxel_m,
    ]
    shape = (poses, *grid.shape)
    observed, free = (wp.zeros(shape, dtype=wp.bool, device=device) for _ in range(2))
    # a grid's voxels one after the other, as the walk numbers them
    rows = [grids.reshape((poses, math.prod(grid.shape))) for grids in (observed, free)]
    for at_end in (False, True):  # what one ray crosses, another may return from
        inputs = [*scans, float(max_range_m), at_end, *rows]
        wp.launch(_mark, dim=ranges.shape, inputs=inputs, device=device)
    return observed, free


@wp.kernel
def _mark(
    ranges: wp.array2d[wp.float64],
    origins: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    corners: wp.array[wp.vec3d],
    shape: wp.vec3i,
    voxel_m: wp.float64,
    max_range_m: wp.float64,
    at_end: wp.bool,
    observed: wp.array2d[wp.bool],
    free: wp.array2d[wp.bool],
) -> None:
    """The voxels on every ray's way, or those that hold its return."""
    p, n = wp.tid()
    o, d, corner = origins[p], directions[p, n], corners[p]
    reach = wp.float64(wp.float32(ranges[p, n]))
    if not at_end:
        end = reach if reach < INF else max_range_m
        clear_voxels(o, d, end, corner, voxel_m, shape[0], shape[1], shape[2], free[p])
    elif reach < INF:
        cell = voxel_at(o, d, reach, corner, voxel_m, shape[0], shape[1], shape[2])
        if cell >= 0:
            observed[p, cell] = True
            free[p, cell] = False
