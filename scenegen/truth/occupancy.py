"""Exact occupancy: the voxels whose closed cube touches a solid, or its surface."""

import math

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.grid import GridSpec, Mask, finite
from lidarsim.jit import kernel
from lidarsim.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID, Solids, local
from scenegen.truth.shapes import distance, moved, touches, within
from scenegen.truth.triangles import (
    bounds,
    crossing,
    height_over,
    numbered,
    side,
    triangle_touches,
)

SLACK_M = 1e-6
"""A cube touches a solid within this distance, so that a return stored in float32 lies in an
occupied voxel."""
SPARE_M = 0.1 * SLACK_M
"""What a quicker test decides by less than this, is decided by the exact one."""
X, Y, Z = map(np.int64, range(3))
"""Axes. Given as literals, numba would compile a kernel anew for each pair of them."""


def rasterize(solids: Solids, grid: GridSpec, origin: ArrayLike) -> Mask:
    """Occupancy (*grid.shape) of the grid whose least corner is `origin` (3,), world metres.

    True where the voxel's closed cube lies within `SLACK_M` of a solid, decided by closed forms,
    never by sampling. On a `grid.hollow`, of the surface of a solid: a cube that lies deeper than
    `SLACK_M` in a solid does not touch it. Raises ValueError for an `origin` that is no point.
    """
    occupancy = np.zeros(grid.shape, bool)
    origin = finite("origin", origin, 3)
    _fill_primitives(
        solids.shape,
        solids.size,
        solids.position,
        solids.rotation,
        solids.lower,
        solids.upper,
        origin,
        grid.voxel_m,
        SLACK_M if grid.hollow else None,
        occupancy,
    )
    for mesh, filled in enumerate(solids.mesh_filled):
        triangles = solids.triangles[solids.mesh_start[mesh] : solids.mesh_start[mesh + 1]]
        _fill_surface(triangles, origin, grid.voxel_m, occupancy)
        if filled and not grid.hollow:
            inside_columns(triangles, origin, grid.voxel_m, occupancy)
    return occupancy


@kernel
def span(low, high, origin, voxel_m, count):
    """First and one past the last voxel along an axis whose closed extent touches [low, high]."""
    cells = float(count)
    first = math.ceil(min(max((low - SLACK_M - origin) / voxel_m - 1.0, 0.0), cells))
    last = math.floor(max(min((high + SLACK_M - origin) / voxel_m, cells - 1.0), -1.0))
    return int(first), int(last) + 1


@kernel
def spans(low, high, origin, voxel_m, shape):
    """`span` along the three axes: first and one past the last of each."""
    i0, i1 = span(low[0], high[0], origin[0], voxel_m, shape[0])
    j0, j1 = span(low[1], high[1], origin[1], voxel_m, shape[1])
    k0, k1 = span(low[2], high[2], origin[2], voxel_m, shape[2])
    return i0, i1, j0, j1, k0, k1


@kernel
def _fill_primitives(
    shape, size, position, rotation, lower, upper, origin, voxel_m, deepest, occupancy
):
    """Mark every primitive's voxels, but for those that lie farther than `deepest` metres inside
    it; None marks these, too, and spares numba the code that finds them."""
    half = 0.5 * voxel_m
    for n in range(len(shape)):
        i0, i1, j0, j1, k0, k1 = spans(lower[n], upper[n], origin, voxel_m, occupancy.shape)
        kind, sizes, axes = shape[n], size[n], rotation[n]
        dz = origin[2] + (k0 + 0.5) * voxel_m - position[n, 2]
        upright = axes[2, 0] == 0.0 and axes[2, 1] == 0.0 and kind in (CYLINDER, BOX)
        for i in range(i0, i1):
            dx = origin[0] + (i + 0.5) * voxel_m - position[n, 0]
            for j in range(j0, j1):
                dy = origin[1] + (j + 0.5) * voxel_m - position[n, 1]
                if upright:
                    low, high = 0, k1 - k0
                    if not touches_section(kind, sizes, axes, dx, dy, half):
                        continue
                else:
                    low, high = touched(kind, sizes, axes, dx, dy, dz, voxel_m, k1 - k0)
                column = occupancy[i, j]
                for k in range(k0 + low, k0 + high):
                    if deepest is None:
                        column[k] = True
                    elif not column[k]:
                        h = origin[2] + (k + 0.5) * voxel_m - position[n, 2]
                        deep = within(kind, sizes, axes, local(axes, dx, dy, h), half, deepest)
                        column[k] = not deep


@kernel
def touches_section(shape, size, axes, dx, dy, half):
    """Whether the square about (dx, dy) touches the section of an upright cylinder or box; along
    the world's axes, the bounding box has told already."""
    if shape == CYLINDER:
        u, v = max(abs(dx) - half, 0.0), max(abs(dy) - half, 0.0)
        reach = size[0] + SLACK_M
        return u * u + v * v <= reach * reach
    x = axes[0, 0] * dx + axes[1, 0] * dy
    y = axes[0, 1] * dx + axes[1, 1] * dy
    reach = half * (abs(axes[0, 0]) + abs(axes[1, 0])) + SLACK_M
    return abs(x) <= size[0] + reach and abs(y) <= size[1] + reach


@kernel
def touched(shape, size, axes, dx, dy, dz, voxel_m, count):
    """Which of `count` voxels of one column, all in the shape's bounding box, touch it: the first
    one, and one past the last. The centre of the column's first lies at (dx, dy, dz) from the
    shape's.

    A cube holds the ball of its half edge and lies in the ball of its half diagonal, so the
    distance of its centre settles all but the cubes right at the surface; and since that distance
    cannot fall faster than one walks, far ones are skipped. Shapes are convex: the column is walked
    from its foot to the first cube that touches, and from its top to the last. The centres of cubes
    that touch an ellipsoid lie in a larger one, and those in a smaller one's do.
    """
    half, most = 0.5 * voxel_m, float(count)
    outer = half * math.sqrt(3.0) + SLACK_M
    x, y, z = local(axes, dx, dy, 0.0)
    foot = (x, y, z)
    h0, h1, sure0, sure1 = -math.inf, math.inf, math.inf, -math.inf
    if shape == ELLIPSOID:
        a, b, c = size[0], size[1], size[2]
        grown = 1.0 + (outer + SLACK_M) / min(min(a, b), c)
        h0, h1 = _chord(a * grown, b * grown, c * grown, axes, x, y, z)
        grown = 1.0 + (half - SLACK_M) / max(max(a, b), c)
        sure0, sure1 = _chord(a * grown, b * grown, c * grown, axes, x, y, z)
    elif shape in (CYLINDER, CAPSULE):
        radius = size[0] + outer + SLACK_M
        h0, h1 = _chord(radius, radius, math.inf, axes, x, y, z)
    lowest = math.ceil(min(max((h0 - dz) / voxel_m, 0.0), most))
    highest = math.floor(min(max((h1 - dz) / voxel_m + 1.0, 0.0), most))
    low, high, found = int(lowest), int(highest), 0
    while low + found < high:
        at = low if found == 0 else high - 1
        h = dz + float(at) * voxel_m
        step = 1
        meets = h >= sure0 and h <= sure1
        if not meets:
            at_h = moved(foot, axes, 2, h)
            gap = distance(shape, size, at_h[0], at_h[1], at_h[2])
            if gap > outer:
                step = max(int(min((gap - outer) / voxel_m, most)), 1)
            else:
                meets = gap <= half or touches(shape, size, axes, at_h, half, SLACK_M)
        if meets:
            if found == 1:
                break
            found, step = 1, 0
        if found == 0:
            low += step
        else:
            high = max(high - step, low + 1)
    return low, high


@kernel
def _chord(a, b, c, axes, x, y, z):
    """Between which heights the vertical line through (x, y, z) lies in the ellipsoid of semi-axes
    a, b and c; none where it passes by."""
    p, q, r = x / a, y / b, z / c
    u, v, w = axes[2, 0] / a, axes[2, 1] / b, axes[2, 2] / c
    square, both = max(u * u + v * v + w * w, 1e-16), u * p + v * q + w * r
    left = both * both - square * (p * p + q * q + r * r - 1.0)
    if left < 0.0:
        return math.inf, -math.inf
    return (-both - math.sqrt(left)) / square, (-both + math.sqrt(left)) / square


@kernel
def _spans_of(a, b, c, origin, voxel_m, shape):
    """`spans` of a triangle."""
    low = (min(a[0], b[0], c[0]), min(a[1], b[1], c[1]), min(a[2], b[2], c[2]))
    high = (max(a[0], b[0], c[0]), max(a[1], b[1], c[1]), max(a[2], b[2], c[2]))
    return spans(low, high, origin, voxel_m, shape)


@kernel
def _fill_surface(triangles, origin, voxel_m, occupancy):
    """Mark the voxels that triangles (T, 3, 3) pass through.

    Each test of `triangle_touches` holds for an interval of a row of columns or of a column. Where
    what remains does not settle whether a voxel lies in all of them, the test itself is made.
    """
    half, slack, spare = 0.5 * voxel_m, SLACK_M / voxel_m, SPARE_M / voxel_m
    corners = np.empty((3, 3))
    across, up_x, up_y = np.empty((3, 4, max(occupancy.shape)))
    for n in range(len(triangles)):
        a, b, c = triangles[n]
        i0, i1, j0, j1, k0, k1 = _spans_of(a, b, c, origin, voxel_m, occupancy.shape)
        if i0 >= i1 or j0 >= j1 or k0 >= k1:
            continue
        size, noise = numbered(triangles[n], origin, voxel_m, corners)
        bounds(corners, X, Y, i0, i1, 0.5, slack, spare, noise, across)
        bounds(corners, X, Z, i0, i1, 0.5, slack, spare, noise, up_x)
        bounds(corners, Y, Z, j0, j1, 0.5, slack, spare, noise, up_y)
        ux, uy, uz = corners[1] - corners[0]
        vx, vy, vz = corners[2] - corners[0]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        if nz < 0.0:
            nx, ny, nz = -nx, -ny, -nz
        length, pace = math.sqrt(nx * nx + ny * ny + nz * nz), 1.0 / max(nz, 1e-300)
        reach = 0.5 * (abs(nx) + abs(ny) + nz) + slack * length
        doubt, bottom, top = spare * length + noise * size, float(k0), k1 - 1.0
        for i in range(i0, i1):
            for j in range(j0, j1):
                if j < across[0, i] or j > across[3, i]:
                    continue
                level = nx * (corners[0, 0] - i) + ny * (corners[0, 1] - j) + nz * corners[0, 2]
                least, most = level - reach, level + reach
                may = max(max(up_x[0, i], up_y[0, j]), (least - doubt) * pace)
                must = max(max(up_x[1, i], up_y[1, j]), (least + doubt) * pace)
                must_not = min(min(up_x[2, i], up_y[2, j]), (most - doubt) * pace)
                may_not = min(min(up_x[3, i], up_y[3, j]), (most + doubt) * pace)
                first = math.ceil(min(max(may, bottom), top + 1.0))
                last = math.floor(max(min(may_not, top), bottom - 1.0))
                sure = across[1, i] <= j <= across[2, i]
                if sure and must <= first and last <= must_not:
                    for k in range(first, last + 1):
                        occupancy[i, j, k] = True
                    continue
                x, y = origin[0] + (i + 0.5) * voxel_m, origin[1] + (j + 0.5) * voxel_m
                for k in range(first, last + 1):
                    z = origin[2] + (k + 0.5) * voxel_m
                    if not occupancy[i, j, k] and triangle_touches(a, b, c, x, y, z, half, SLACK_M):
                        occupancy[i, j, k] = True


@kernel
def inside_columns(triangles, origin, voxel_m, occupancy):
    """Mark the voxels whose centre a closed, consistently wound soup (T, 3, 3) winds around.

    With the voxels on its surface marked already, what is left lies wholly inside or outside, so
    the centre decides.
    """
    nx, ny, nz = occupancy.shape
    i_low, i_high, j_low, j_high, k_high = nx, 0, ny, 0, 0
    for a, b, c in triangles:
        i0, i1, j0, j1, _, k1 = _spans_of(a, b, c, origin, voxel_m, occupancy.shape)
        i_low, i_high, j_low = min(i_low, i0), max(i_high, i1), min(j_low, j0)
        j_high, k_high = max(j_high, j1), max(k_high, k1)
    if i_low >= i_high or j_low >= j_high or k_high == 0:
        return
    winding = np.zeros((i_high - i_low, j_high - j_low, nz), np.int32)
    # the lowest voxel of a column that changes
    first = np.full((i_high - i_low, j_high - j_low), nz, np.int32)
    corners, across = np.empty((3, 3)), np.empty((4, nx))
    for n in range(len(triangles)):
        a, b, c = triangles[n]
        i0, i1, j0, j1, _, _ = _spans_of(a, b, c, origin, voxel_m, occupancy.shape)
        if i0 >= i1 or j0 >= j1:
            continue
        _, noise = numbered(triangles[n], origin, voxel_m, corners)
        bounds(corners, X, Y, i0, i1, 0.0, 0.0, noise, noise, across)
        up = side(a, b, c[0], c[1])
        for i in range(i0, i1):
            x = origin[0] + (i + 0.5) * voxel_m
            for j in range(j0, j1):
                if j < across[0, i] or j > across[3, i]:
                    continue
                y = origin[1] + (j + 0.5) * voxel_m
                if across[1, i] <= j <= across[2, i]:
                    sign, height = up, height_over(a, b, c, x, y)
                else:
                    sign, height = crossing(a, b, c, x, y)
                if sign != 0:
                    k = max(math.ceil((height - origin[2]) / voxel_m - 0.5), 0)
                    if k < nz:
                        winding[i - i_low, j - j_low, k] += sign
                        first[i - i_low, j - j_low] = min(first[i - i_low, j - j_low], k)
    for i in range(i_low, i_high):
        for j in range(j_low, j_high):
            total = 0
            for k in range(first[i - i_low, j - j_low], nz):
                total += winding[i - i_low, j - j_low, k]
                if total != 0:
                    occupancy[i, j, k] = True
