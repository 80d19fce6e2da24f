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
"""Where a quick test decides by a smaller margin than this, the exact one decides."""
X, Y, Z = map(np.int64, range(3))
"""Axes. Given as literals, numba would compile a kernel anew for each pair of them."""


def rasterize(solids: Solids, grid: GridSpec, origin: ArrayLike) -> Mask:
    """Compute the occupancy of a grid by closed forms, never by sampling.

    Args:
        solids: The world.
        grid: The grid to fill.
        origin: (3,): its least corner in the world, metres.

    Returns:
        (*grid.shape): whether the voxel's closed cube lies within `SLACK_M` of a solid. On a
        `grid.hollow`, of a solid's surface: cubes that lie deeper than `SLACK_M` in it are left
        out.

    Raises:
        ValueError: If `origin` is not three finite numbers.
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
    """Find the voxels along an axis whose closed extent touches an interval.

    Args:
        low, high: The interval, metres.
        origin: Where the grid begins, metres.
        voxel_m: Edge of a voxel, metres.
        count: Voxels of the grid.

    Returns:
        First voxel, and one past the last.
    """
    cells = float(count)
    # clamped as floats: an infinite extent, a plane's, is no integer
    first = math.ceil(min(max((low - SLACK_M - origin) / voxel_m - 1.0, 0.0), cells))
    last = math.floor(max(min((high + SLACK_M - origin) / voxel_m, cells - 1.0), -1.0))
    return int(first), int(last) + 1


@kernel
def spans(low, high, origin, voxel_m, shape):
    """Apply `span` along the three axes.

    Args:
        low, high: Corners of a box, (3,) each, metres.
        origin: (3,): the grid's least corner, metres.
        voxel_m: Edge of a voxel, metres.
        shape: (3,): the grid's.

    Returns:
        First and one past the last, for each axis in turn.
    """
    i0, i1 = span(low[0], high[0], origin[0], voxel_m, shape[0])
    j0, j1 = span(low[1], high[1], origin[1], voxel_m, shape[1])
    k0, k1 = span(low[2], high[2], origin[2], voxel_m, shape[2])
    return i0, i1, j0, j1, k0, k1


@kernel
def _fill_primitives(
    shape, size, position, rotation, lower, upper, origin, voxel_m, deepest, occupancy
):
    """Mark every primitive's voxels but those farther than `deepest` metres inside it.

    None marks all, and spares numba the code that finds deep ones."""
    half = 0.5 * voxel_m
    for n in range(len(shape)):
        i0, i1, j0, j1, k0, k1 = spans(lower[n], upper[n], origin, voxel_m, occupancy.shape)
        kind, sizes, axes = shape[n], size[n], rotation[n]
        dz = origin[2] + (k0 + 0.5) * voxel_m - position[n, 2]
        # all columns of an upright prism have the same height, so one planar test decides a column
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
    """Test whether a square touches the section of an upright cylinder or box.

    The faces along the world's axes need no test: the caller walks the bounding box only.

    Args:
        shape: Cylinder or box.
        size: (3,), metres.
        axes: (3, 3): the shape's rotation.
        dx, dy: The square's centre, relative to the shape's, world axes, metres.
        half: Half its edge, metres.

    Returns:
        Whether it touches, within `SLACK_M`.
    """
    if shape == CYLINDER:
        u, v = max(abs(dx) - half, 0.0), max(abs(dy) - half, 0.0)
        reach = size[0] + SLACK_M
        return u * u + v * v <= reach * reach
    x = axes[0, 0] * dx + axes[1, 0] * dy
    y = axes[0, 1] * dx + axes[1, 1] * dy
    # half the square's width along either axis of the box
    reach = half * (abs(axes[0, 0]) + abs(axes[1, 0])) + SLACK_M
    return abs(x) <= size[0] + reach and abs(y) <= size[1] + reach


@kernel
def touched(shape, size, axes, dx, dy, dz, voxel_m, count):
    """Find the voxels of one column that touch a shape.

    A cube holds the ball of its half edge and lies in the ball of its half diagonal, so the
    distance of its centre settles all but the cubes right at the surface; and since that distance
    changes by no more than the way walked, far cubes are skipped. Shapes are convex: the column is
    walked from its foot to the first cube that touches, and from its top to the last. The centres
    of cubes that touch an ellipsoid lie in a larger one, and all cubes with a centre in a smaller
    one touch it.

    Args:
        shape, size: Of the primitive.
        axes: (3, 3): its rotation.
        dx, dy, dz: The centre of the column's first voxel, relative to the shape's, world axes,
            metres.
        voxel_m: Edge of a voxel, metres.
        count: Voxels of the column, all in the shape's bounding box.

    Returns:
        First voxel that touches, and one past the last.
    """
    half, limit = 0.5 * voxel_m, float(count)
    # half the diagonal: a centre farther away than this is of no touching cube
    outer = half * math.sqrt(3.0) + SLACK_M
    x, y, z = local(axes, dx, dy, 0.0)
    foot = (x, y, z)
    h0, h1, sure0, sure1 = -math.inf, math.inf, math.inf, -math.inf
    if shape == ELLIPSOID:
        a, b, c = size[0], size[1], size[2]
        # scaling by 1 + d / least semi-axis moves the surface out by d everywhere, or more
        grown = 1.0 + (outer + SLACK_M) / min(min(a, b), c)
        h0, h1 = _chord(a * grown, b * grown, c * grown, axes, x, y, z)
        # by 1 + d / greatest semi-axis, by d at most
        grown = 1.0 + (half - SLACK_M) / max(max(a, b), c)
        sure0, sure1 = _chord(a * grown, b * grown, c * grown, axes, x, y, z)
    elif shape in (CYLINDER, CAPSULE):
        radius = size[0] + outer + SLACK_M
        h0, h1 = _chord(radius, radius, math.inf, axes, x, y, z)
    lowest = math.ceil(min(max((h0 - dz) / voxel_m, 0.0), limit))
    highest = math.floor(min(max((h1 - dz) / voxel_m + 1.0, 0.0), limit))
    # stage 0 seeks the lowest cube, stage 1 the highest
    low, high, stage = int(lowest), int(highest), 0
    while low + stage < high:
        cell = low if stage == 0 else high - 1
        h = dz + float(cell) * voxel_m
        step = 1
        meets = h >= sure0 and h <= sure1
        if not meets:
            at_h = moved(foot, axes, 2, h)
            gap = distance(shape, size, at_h[0], at_h[1], at_h[2])
            if gap > outer:
                # the gap shrinks by at most a voxel's edge for each voxel walked
                step = max(int(min((gap - outer) / voxel_m, limit)), 1)
            else:
                meets = gap <= half or touches(shape, size, axes, at_h, half, SLACK_M)
        if meets:
            if stage == 1:
                break
            stage, step = 1, 0
        if stage == 0:
            low += step
        else:
            # the lowest cube touches, so the column has at least that one
            high = max(high - step, low + 1)
    return low, high


@kernel
def _chord(a, b, c, axes, x, y, z):
    """Return the heights between which the vertical line through (x, y, z) lies in an ellipsoid.

    Its semi-axes are a, b and c; the interval is [inf, -inf] where the line misses."""
    p, q, r = x / a, y / b, z / c
    u, v, w = axes[2, 0] / a, axes[2, 1] / b, axes[2, 2] / c
    # a quadratic in the height: square h² + 2 half_slope h + (p² + q² + r² - 1) = 0
    square, half_slope = max(u * u + v * v + w * w, 1e-16), u * p + v * q + w * r
    left = half_slope * half_slope - square * (p * p + q * q + r * r - 1.0)
    if left < 0.0:
        return math.inf, -math.inf
    return (-half_slope - math.sqrt(left)) / square, (-half_slope + math.sqrt(left)) / square


@kernel
def _spans_of(a, b, c, origin, voxel_m, shape):
    """Apply `spans` to a triangle's bounding box."""
    low = (min(a[0], b[0], c[0]), min(a[1], b[1], c[1]), min(a[2], b[2], c[2]))
    high = (max(a[0], b[0], c[0]), max(a[1], b[1], c[1]), max(a[2], b[2], c[2]))
    return spans(low, high, origin, voxel_m, shape)


@kernel
def _fill_surface(triangles, origin, voxel_m, occupancy):
    """Mark the voxels that triangles (T, 3, 3) pass through.

    Each test of `triangle_touches` holds for an interval of a row of columns or of a column. If
    these intervals do not decide whether a voxel lies in all of them, the test itself is made."""
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
        # the plane is the same; then heights of the plane's slab rise with `level`
        if nz < 0.0:
            nx, ny, nz = -nx, -ny, -nz
        # as in `bounds`: no NaN where the plane is vertical
        length, pace = math.sqrt(nx * nx + ny * ny + nz * nz), 1.0 / max(nz, 1e-300)
        # half a voxel's extent along the normal
        reach = 0.5 * (abs(nx) + abs(ny) + nz) + slack * length
        doubt, bottom, top = spare * length + noise * size, float(k0), k1 - 1.0
        for i in range(i0, i1):
            for j in range(j0, j1):
                if j < across[0, i] or j > across[3, i]:
                    continue
                # where the plane lies above the column's foot, times nz
                level = nx * (corners[0, 0] - i) + ny * (corners[0, 1] - j) + nz * corners[0, 2]
                lowest, highest = level - reach, level + reach
                # `may` and `may_not` bound the voxels that could touch, `must` and `must_not` those
                # that do
                may = max(max(up_x[0, i], up_y[0, j]), (lowest - doubt) * pace)
                must = max(max(up_x[1, i], up_y[1, j]), (lowest + doubt) * pace)
                must_not = min(min(up_x[2, i], up_y[2, j]), (highest - doubt) * pace)
                may_not = min(min(up_x[3, i], up_y[3, j]), (highest + doubt) * pace)
                first = math.ceil(min(max(may, bottom), top + 1.0))
                last = math.floor(max(min(may_not, top), bottom - 1.0))
                sure = across[1, i] <= j <= across[2, i]
                # every voxel that may touch surely does
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
    """Mark the voxels whose centre a closed, consistently wound soup of triangles winds around.

    Voxels on its surface are marked already; others lie wholly inside or outside, so the centre
    decides.

    Args:
        triangles: (T, 3, 3), metres, in the world.
        origin: (3,): the grid's least corner, metres.
        voxel_m: Edge of a voxel, metres.
        occupancy: (nx, ny, nz): set to True in place.
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
                # surely inside the triangle's shadow, whose sense one edge tells
                if across[1, i] <= j <= across[2, i]:
                    sign, height = up, height_over(a, b, c, x, y)
                else:
                    sign, height = crossing(a, b, c, x, y)
                if sign != 0:
                    # the crossing counts for all centres above it
                    k = max(math.ceil((height - origin[2]) / voxel_m - 0.5), 0)
                    if k < nz:
                        # differences along the column, summed up below
                        winding[i - i_low, j - j_low, k] += sign
                        first[i - i_low, j - j_low] = min(first[i - i_low, j - j_low], k)
    for i in range(i_low, i_high):
        for j in range(j_low, j_high):
            total = 0
            for k in range(first[i - i_low, j - j_low], nz):
                total += winding[i - i_low, j - j_low, k]
                if total != 0:
                    occupancy[i, j, k] = True
