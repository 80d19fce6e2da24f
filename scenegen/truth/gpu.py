"""Exact occupancy and distances of many worlds at once, in Warp: the bits of `rasterize` and
`distance_field`.

One thread fills one column of voxels, by the functions of `rasterize`, or finds the distance of one
voxel.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.gpu.translate import translated
from lidarsim.gpu.worlds import EXACT, Packed, Worlds, on_device, wp
from lidarsim.grid import GridSpec
from lidarsim.solids.shapes import BOX, CYLINDER
from scenegen.truth import occupancy as cpu
from scenegen.truth import triangles
from scenegen.truth.distance import lookup

wp.set_module_options(EXACT)
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
SLACK = wp.constant(wp.float64(cpu.SLACK_M))
span = translated(cpu.span)
touches_section = translated(cpu.touches_section)
touched = translated(cpu.touched)
triangle_touches = translated(triangles.triangle_touches)
crossing = translated(triangles.crossing)


def rasterize(
    worlds: Worlds, grid: GridSpec, corners: Any, *, which: ArrayLike | None = None
) -> Any:
    """Mark the voxels of P grids whose closed cube lies within `SLACK_M` of a solid.

    Grid p has its least corner at `corners` (P, 3), in world `which` (P,), which is world p unless
    said otherwise.

    Returns:
        Occupancy (P, *grid.shape), a Warp array of bool on the worlds' device.

    Raises:
        ValueError: for other shapes, and for a grid that is `hollow`.
    """
    if grid.hollow:
        raise ValueError(
            "grid.hollow = True: expected False on the GPU; scenegen.truth.rasterize knows surfaces"
        )
    poses = (*np.shape(corners), 0)[0]
    lows = on_device("corners", corners, wp.vec3d, (poses,), worlds.device)
    occupancy = wp.zeros((poses, *grid.shape), dtype=wp.bool, device=worlds.device)
    # of closed meshes, by how much the winding number changes in each voxel
    counted = occupancy.shape if len(worlds.packed.triangles) else (0, 0, 0, 0)
    winding = wp.zeros(counted, dtype=wp.int32, device=worlds.device)
    inputs = [worlds.packed, worlds.which(which, poses), lows, grid.voxel_m, occupancy, winding]
    wp.launch(_fill, dim=occupancy.shape[:3], inputs=inputs, device=worlds.device)
    return occupancy


def distance_field(occupancy: Any, grid: GridSpec) -> Any:
    """The TUDFs of P grids from their `occupancy` (P, *grid.shape), a Warp array.

    Returns:
        Metres from each voxel's centre to the nearest occupied one's, at most `grid.truncation_m`:
        a Warp array (P, *grid.shape) of float32 on the same device.
    """
    device, shape = occupancy.device.alias, (len(occupancy), *grid.shape)
    on_device("occupancy", occupancy, wp.bool, shape, device)
    cap, table = lookup(grid)
    squares, spread = (wp.empty(shape, dtype=wp.int32, device=device) for _ in range(2))
    wp.launch(_begin, dim=shape, inputs=[occupancy, cap, squares], device=device)
    for axis in np.eye(3, dtype=int):
        wp.launch(_spread, dim=shape, inputs=[squares, wp.vec3i(*axis), spread], device=device)
        squares, spread = spread, squares
    metres = wp.array(table, dtype=wp.float32, device=device)
    field = wp.empty(shape, dtype=wp.float32, device=device)
    wp.launch(_look_up, dim=shape, inputs=[squares, metres, field], device=device)
    return field


@wp.func
def _centre(origin: wp.float64, i: wp.int32, voxel_m: wp.float64) -> wp.float64:
    return origin + (wp.float64(i) + HALF) * voxel_m


@wp.func
def _touched(
    low: wp.vec3d,
    high: wp.vec3d,
    o: wp.vec3d,
    i: wp.int32,
    j: wp.int32,
    voxel_m: wp.float64,
    shape: wp.vec3i,
) -> wp.vec2i:
    """First and one past the last voxel of the column i, j that touches a box; the last is -1 where
    the column passes the box by."""
    x, y = o[0] + wp.float64(i) * voxel_m, o[1] + wp.float64(j) * voxel_m
    far = voxel_m + voxel_m  # a voxel to spare: quicker than `span`, for most
    if x > high[0] + voxel_m or x < low[0] - far or y > high[1] + voxel_m or y < low[1] - far:
        return wp.vec2i(0, -1)
    i0, i1 = span(low[0], high[0], o[0], voxel_m, shape[0])
    j0, j1 = span(low[1], high[1], o[1], voxel_m, shape[1])
    if i < i0 or i >= i1 or j < j0 or j >= j1:
        return wp.vec2i(0, -1)
    first, end = span(low[2], high[2], o[2], voxel_m, shape[2])
    return wp.vec2i(first, end)


@wp.kernel
def _fill(
    packed: Packed,
    which: wp.array[wp.int32],
    corners: wp.array[wp.vec3d],
    voxel_m: wp.float64,
    occupancy: wp.array4d[wp.bool],
    winding: wp.array4d[wp.int32],
) -> None:
    """One column: primitives; then meshes' surfaces by the cubes that they touch, and the inside of
    closed ones by winding numbers of the voxels' centres."""
    p, i, j = wp.tid()
    o = corners[p]
    shape = wp.vec3i(occupancy.shape[1], occupancy.shape[2], occupancy.shape[3])
    x, y = _centre(o[0], i, voxel_m), _centre(o[1], j, voxel_m)
    for n in range(packed.primitive_start[which[p]], packed.primitive_start[which[p] + 1]):
        ends = _touched(packed.lower[n], packed.upper[n], o, i, j, voxel_m, shape)
        if ends[0] >= ends[1]:
            continue
        kind, size, axes = packed.shape[n], packed.size[n], packed.rotation[n]
        dx = x - packed.position[n, 0]
        dy = y - packed.position[n, 1]
        dz = _centre(o[2], ends[0], voxel_m) - packed.position[n, 2]
        first, end = wp.int32(0), ends[1] - ends[0]
        upright = axes[2, 0] == ZERO and axes[2, 1] == ZERO
        if upright and (kind == CYLINDER or kind == BOX):  # noqa: SIM109 (Warp has no `in`)
            if not touches_section(kind, size, axes, dx, dy, HALF * voxel_m):
                continue
        else:
            first, end = touched(kind, size, axes, dx, dy, dz, voxel_m, end)
        for k in range(ends[0] + first, ends[0] + end):
            occupancy[p, i, j, k] = True
    for m in range(packed.mesh_start[which[p]], packed.mesh_start[which[p] + 1]):
        for n in range(packed.triangle_start[m], packed.triangle_start[m + 1]):
            a, b, c = _corner(packed, n, 0), _corner(packed, n, 1), _corner(packed, n, 2)
            low, high = wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c)
            ends = _touched(low, high, o, i, j, voxel_m, shape)
            if ends[1] < 0:
                continue
            if packed.filled[m] != 0:
                sign, height = crossing(a, b, c, x, y)
                above = wp.ceil((height - o[2]) / voxel_m - HALF)
                if sign != 0 and above < wp.float64(shape[2]):
                    winding[p, i, j, wp.int32(wp.max(above, ZERO))] += sign
            for k in range(ends[0], ends[1]):
                if not occupancy[p, i, j, k]:
                    z = _centre(o[2], k, voxel_m)
                    if triangle_touches(a, b, c, x, y, z, HALF * voxel_m, SLACK):
                        occupancy[p, i, j, k] = True
        if packed.filled[m] != 0:
            total = wp.int32(0)
            for k in range(shape[2]):
                total += winding[p, i, j, k]
                winding[p, i, j, k] = 0
                if total != 0:
                    occupancy[p, i, j, k] = True


@wp.func
def _corner(packed: Packed, n: wp.int32, k: wp.int32) -> wp.vec3d:
    return wp.vec3d(packed.triangles[n, k, 0], packed.triangles[n, k, 1], packed.triangles[n, k, 2])


@wp.kernel
def _begin(occupancy: wp.array4d[wp.bool], cap: wp.int32, squares: wp.array4d[wp.int32]) -> None:
    """Squared distances before any axis is looked along: 0 where occupied, else the most."""
    p, i, j, k = wp.tid()
    squares[p, i, j, k] = 0 if occupancy[p, i, j, k] else cap


@wp.kernel
def _spread(source: wp.array4d[wp.int32], axis: wp.vec3i, squares: wp.array4d[wp.int32]) -> None:
    """The least square on a voxel's line along an axis, each with its own distance added (Saito and
    Toriwaki 1994)."""
    p, i, j, k = wp.tid()
    shape = wp.vec3i(source.shape[1], source.shape[2], source.shape[3])
    least = wp.int32(source[p, i, j, k])
    step = wp.int32(1)
    while step * step < least:
        for side in range(2):
            at = wp.vec3i(i, j, k) + (2 * side - 1) * step * axis
            if wp.min(at) >= 0 and wp.min(shape - at) > 0:
                least = wp.min(least, source[p, at[0], at[1], at[2]] + step * step)
        step += 1
    squares[p, i, j, k] = least


@wp.kernel
def _look_up(
    squares: wp.array4d[wp.int32], metres: wp.array[wp.float32], field: wp.array4d[wp.float32]
) -> None:
    p, i, j, k = wp.tid()
    field[p, i, j, k] = metres[squares[p, i, j, k]]
