"""Exact occupancy and distances of many worlds at once, in Warp: the bits of `rasterize` and
`distance_field`.

One thread fills one column of voxels, or finds the distance of one voxel.
"""

from typing import Any

from numpy.typing import ArrayLike

from lidarsim.gpu.device import EXACT, on_device, placed, wp
from lidarsim.gpu.worlds import Packed, Worlds
from lidarsim.grid import GridSpec
from lidarsim.solids.shapes import BOX, CYLINDER
from scenegen.truth.distance import lookup
from scenegen.truth.gpu_shapes import crossing, distance, touches, triangle_touches
from scenegen.truth.occupancy import SLACK_M

wp.set_module_options(EXACT | {"max_unroll": 1})
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
ROOT_3 = wp.constant(wp.float64(3.0**0.5))
SLACK = wp.constant(wp.float64(SLACK_M))


def rasterize(
    worlds: Worlds, grid: GridSpec, corners: Any, *, which: ArrayLike | None = None
) -> Any:
    """Occupancy (P, *grid.shape) of P grids, a Warp array of bool on the worlds' device.

    Grid p has its least corner at `corners` (P, 3), in world `which` (P,), which is world p unless
    said otherwise. A voxel is occupied where its closed cube lies within `SLACK_M` of a solid.
    Raises ValueError for other shapes, and for a grid that is `hollow`.
    """
    if grid.hollow:
        raise ValueError(
            "grid.hollow = True: expected False on the GPU; scenegen.truth.rasterize knows surfaces"
        )
    lows = on_device(corners, wp.vec3d, worlds.device)
    poses = len(lows)
    placed("corners", lows, (poses,), wp.vec3d, worlds.device)
    chosen = worlds.which(which, poses)
    occupancy = wp.zeros((poses, *grid.shape), dtype=wp.bool, device=worlds.device)
    inputs = [worlds.packed, chosen, lows, grid.voxel_m, occupancy]
    columns = occupancy.shape[:3]
    wp.launch(_fill_primitives, dim=columns, inputs=inputs, device=worlds.device)
    if len(worlds.packed.triangles):
        winding = wp.zeros(occupancy.shape, dtype=wp.int32, device=worlds.device)
        wp.launch(_fill_meshes, dim=columns, inputs=[*inputs, winding], device=worlds.device)
    return occupancy


def distance_field(occupancy: Any, grid: GridSpec) -> Any:
    """The TUDFs of P grids, a Warp array (P, *grid.shape) of float32 on the device of `occupancy`,
    of the same shape: metres from each voxel's centre to the nearest occupied one's, at most
    `grid.truncation_m`."""
    device = occupancy.device.alias
    placed("occupancy", occupancy, (len(occupancy), *grid.shape), wp.bool, device)
    cap, table = lookup(grid)
    along_x, along_y = (wp.empty(occupancy.shape, dtype=wp.int32, device=device) for _ in range(2))
    field = wp.empty(occupancy.shape, dtype=wp.float32, device=device)
    values = wp.array(table, dtype=wp.float32, device=device)
    wp.launch(_along_x, dim=field.shape, inputs=[occupancy, cap, along_x], device=device)
    wp.launch(_along_y, dim=field.shape, inputs=[along_x, along_y], device=device)
    wp.launch(_along_z, dim=field.shape, inputs=[along_y, values, field], device=device)
    return field


@wp.func
def _first(low: wp.float64, origin: wp.float64, voxel_m: wp.float64, count: wp.int32) -> wp.int32:
    """First voxel along an axis whose closed extent touches what begins at `low`."""
    return wp.int32(
        wp.ceil(wp.min(wp.max((low - SLACK - origin) / voxel_m - ONE, ZERO), wp.float64(count)))
    )


@wp.func
def _last(high: wp.float64, origin: wp.float64, voxel_m: wp.float64, count: wp.int32) -> wp.int32:
    """Last voxel along an axis whose closed extent touches what ends at `high`."""
    return wp.int32(
        wp.floor(wp.max(wp.min((high + SLACK - origin) / voxel_m, wp.float64(count) - ONE), -ONE))
    )


@wp.func
def _is_beside(
    low: wp.vec3d, high: wp.vec3d, o: wp.vec3d, i: wp.int32, j: wp.int32, voxel_m: wp.float64
) -> wp.bool:
    """Whether the column i, j passes a box by, with a voxel to spare: quicker than the exact
    answer, for most."""
    x, y = o[0] + wp.float64(i) * voxel_m, o[1] + wp.float64(j) * voxel_m
    two = voxel_m + voxel_m
    return x > high[0] + voxel_m or x < low[0] - two or y > high[1] + voxel_m or y < low[1] - two


@wp.func
def _reaches(
    low: wp.vec3d,
    high: wp.vec3d,
    o: wp.vec3d,
    i: wp.int32,
    j: wp.int32,
    voxel_m: wp.float64,
    nx: wp.int32,
    ny: wp.int32,
) -> wp.bool:
    """Whether the voxels of column i, j touch a box, seen from above."""
    if i < _first(low[0], o[0], voxel_m, nx) or i > _last(high[0], o[0], voxel_m, nx):
        return False
    return j >= _first(low[1], o[1], voxel_m, ny) and j <= _last(high[1], o[1], voxel_m, ny)


@wp.kernel
def _fill_primitives(
    packed: Packed,
    which: wp.array[wp.int32],
    corners: wp.array[wp.vec3d],
    voxel_m: wp.float64,
    occupancy: wp.array4d[wp.bool],
) -> None:
    p, i, j = wp.tid()
    o = corners[p]
    half = HALF * voxel_m
    outer = half * ROOT_3 + SLACK
    nx, ny, nz = occupancy.shape[1], occupancy.shape[2], occupancy.shape[3]
    x, y = o[0] + (wp.float64(i) + HALF) * voxel_m, o[1] + (wp.float64(j) + HALF) * voxel_m
    for n in range(packed.primitive_start[which[p]], packed.primitive_start[which[p] + 1]):
        low, high = packed.lower[n], packed.upper[n]
        if _is_beside(low, high, o, i, j, voxel_m) or not _reaches(
            low, high, o, i, j, voxel_m, nx, ny
        ):
            continue
        begin, last = _first(low[2], o[2], voxel_m, nz), _last(high[2], o[2], voxel_m, nz)
        shape, size, axes = packed.shape[n], packed.size[n], packed.rotation[n]
        dx, dy = x - packed.position[n][0], y - packed.position[n][1]
        if axes[2, 0] == ZERO and axes[2, 1] == ZERO and (shape == CYLINDER or shape == BOX):  # noqa: SIM109
            if _column_touches(shape, size, axes, dx, dy, half):
                for k in range(begin, last + 1):
                    occupancy[p, i, j, k] = True
            continue
        dz = o[2] + (wp.float64(begin) + HALF) * voxel_m - packed.position[n][2]
        inwards = wp.transpose(axes)
        k = wp.int32(begin)
        while k <= last:
            at = inwards * wp.vec3d(dx, dy, dz + wp.float64(k - begin) * voxel_m)
            gap = distance(shape, size, at)
            if gap > outer:  # which cannot fall faster than one walks: far ones are skipped
                k += wp.max(wp.int32(wp.min((gap - outer) / voxel_m, wp.float64(nz))), 1)
                continue
            if gap <= half or touches(shape, size, axes, at, half, SLACK):
                occupancy[p, i, j, k] = True
            k += 1


@wp.func
def _column_touches(
    shape: wp.int32,
    size: wp.vec3d,
    axes: wp.mat33d,
    dx: wp.float64,
    dy: wp.float64,
    half: wp.float64,
) -> wp.bool:
    """Whether the square about (dx, dy), relative to an upright cylinder's or box's axis, touches
    its section."""
    if shape == CYLINDER:
        g, h = wp.max(wp.abs(dx) - half, ZERO), wp.max(wp.abs(dy) - half, ZERO)
        return g * g + h * h <= (size[0] + SLACK) * (size[0] + SLACK)
    c, s = wp.abs(axes[0, 0]), wp.abs(axes[1, 0])
    if wp.abs(dx) > c * size[0] + s * size[1] + half + SLACK:
        return False
    if wp.abs(dy) > s * size[0] + c * size[1] + half + SLACK:
        return False
    u, v = axes[0, 0] * dx + axes[1, 0] * dy, axes[0, 1] * dx + axes[1, 1] * dy
    reach = half * (c + s) + SLACK
    return wp.abs(u) <= size[0] + reach and wp.abs(v) <= size[1] + reach


@wp.kernel
def _fill_meshes(
    packed: Packed,
    which: wp.array[wp.int32],
    corners: wp.array[wp.vec3d],
    voxel_m: wp.float64,
    occupancy: wp.array4d[wp.bool],
    winding: wp.array4d[wp.int32],
) -> None:
    """Surfaces by the cubes that they touch; the inside of closed ones by winding numbers of the
    voxels' centres."""
    p, i, j = wp.tid()
    o = corners[p]
    half = HALF * voxel_m
    nx, ny, nz = occupancy.shape[1], occupancy.shape[2], occupancy.shape[3]
    x, y = o[0] + (wp.float64(i) + HALF) * voxel_m, o[1] + (wp.float64(j) + HALF) * voxel_m
    for m in range(packed.mesh_start[which[p]], packed.mesh_start[which[p] + 1]):
        for n in range(packed.triangle_start[m], packed.triangle_start[m + 1]):
            a, b, c = packed.triangles[n, 0], packed.triangles[n, 1], packed.triangles[n, 2]
            low, high = wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c)
            if _is_beside(low, high, o, i, j, voxel_m):
                continue
            if packed.filled[m] != 0:
                sign, height = crossing(a, b, c, x, y)
                above = wp.ceil((height - o[2]) / voxel_m - HALF)
                if sign != 0 and above < wp.float64(nz):
                    winding[p, i, j, wp.int32(wp.max(above, ZERO))] += sign
            if _reaches(low, high, o, i, j, voxel_m, nx, ny):
                for k in range(
                    _first(low[2], o[2], voxel_m, nz), _last(high[2], o[2], voxel_m, nz) + 1
                ):
                    if not occupancy[p, i, j, k]:
                        centre = wp.vec3d(x, y, o[2] + (wp.float64(k) + HALF) * voxel_m)
                        if triangle_touches(a, b, c, centre, half, SLACK):
                            occupancy[p, i, j, k] = True
        if packed.filled[m] != 0:
            total = wp.int32(0)
            for k in range(nz):
                total += winding[p, i, j, k]
                winding[p, i, j, k] = 0
                if total != 0:
                    occupancy[p, i, j, k] = True


@wp.kernel
def _along_x(occupancy: wp.array4d[wp.bool], cap: wp.int32, squares: wp.array4d[wp.int32]) -> None:
    """Squared steps to the nearest occupied voxel along x, at most `cap` (Saito and Toriwaki
    1994)."""
    p, i, j, k = wp.tid()
    step, found = wp.int32(0), wp.bool(False)
    while step * step < cap and not found:
        if i >= step:
            found = occupancy[p, i - step, j, k]
        if i + step < occupancy.shape[1]:
            found = found or occupancy[p, i + step, j, k]
        if not found:
            step += 1
    squares[p, i, j, k] = wp.min(step * step, cap)


@wp.kernel
def _along_y(source: wp.array4d[wp.int32], squares: wp.array4d[wp.int32]) -> None:
    """The least of a line's squares, each with its own distance along y added."""
    p, i, j, k = wp.tid()
    least = wp.int32(source[p, i, j, k])
    step = wp.int32(1)
    while step * step < least:
        if j >= step:
            least = wp.min(least, source[p, i, j - step, k] + step * step)
        if j + step < source.shape[2]:
            least = wp.min(least, source[p, i, j + step, k] + step * step)
        step += 1
    squares[p, i, j, k] = least


@wp.kernel
def _along_z(
    source: wp.array4d[wp.int32], table: wp.array[wp.float32], field: wp.array4d[wp.float32]
) -> None:
    """The same along z, and the distance that belongs to the square."""
    p, i, j, k = wp.tid()
    least = wp.int32(source[p, i, j, k])
    step = wp.int32(1)
    while step * step < least:
        if k >= step:
            least = wp.min(least, source[p, i, j, k - step] + step * step)
        if k + step < source.shape[3]:
            least = wp.min(least, source[p, i, j, k + step] + step * step)
        step += 1
    field[p, i, j, k] = table[least]
