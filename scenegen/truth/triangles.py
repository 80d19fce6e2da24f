"""Triangles: whether a cube touches one, how far a point is from one, and where a vertical line
crosses one."""

import math

from lidarsim.jit import kernel
from lidarsim.solids import joining


@kernel
def triangle_touches(a, b, c, x, y, z, half, slack):
    """Whether the closed cube about (x, y, z) comes within `slack` metres of the triangle abc.

    Separating axes (Akenine-Moller 2001): the triangle's normal, the cube's faces, and the products
    of their edges, which are tests in the three planes of the axes.
    """
    middle = (x, y, z)
    ax, ay, az = joining(middle, a)
    bx, by, bz = joining(middle, b)
    cx, cy, cz = joining(middle, c)
    reach = half + slack
    if min(ax, bx, cx) > reach or max(ax, bx, cx) < -reach:
        return False
    if min(ay, by, cy) > reach or max(ay, by, cy) < -reach:
        return False
    if min(az, bz, cz) > reach or max(az, bz, cz) < -reach:
        return False
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    reach = half * (abs(nx) + abs(ny) + abs(nz)) + slack * length
    if abs(nx * ax + ny * ay + nz * az) > reach:
        return False
    return (
        meets_square(ax, ay, bx, by, cx, cy, half, slack)
        and meets_square(ay, az, by, bz, cy, cz, half, slack)
        and meets_square(az, ax, bz, bx, cz, cx, half, slack)
    )


@kernel
def meets_square(ax, ay, bx, by, cx, cy, half, slack):
    """Whether no edge of the triangle abc in a plane has it more than `slack` metres apart from the
    square about the origin."""
    return not (
        _apart(ax, ay, bx, by, cx, cy, half, slack)
        or _apart(bx, by, cx, cy, ax, ay, half, slack)
        or _apart(cx, cy, ax, ay, bx, by, half, slack)
    )


@kernel
def _apart(ax, ay, bx, by, cx, cy, half, slack):
    """Whether the line of the edge ab has the triangle abc on one side and the square on the
    other."""
    dx, dy = bx - ax, by - ay
    reach = half * (abs(dx) + abs(dy)) + slack * math.sqrt(dx * dx + dy * dy)
    edge, corner = ay * dx - ax * dy, cy * dx - cx * dy
    # rounding leaves an edge through the square's only point within reach
    reach += 1e-14 * (abs(ay * dx) + abs(ax * dy) + abs(cy * dx) + abs(cx * dy))
    return min(edge, corner) > reach or max(edge, corner) < -reach


@kernel
def numbered(triangle, origin, voxel_m, corners):
    """Fill `corners` (3, 3) with a triangle's, counted in voxels from the first one's centre.

    Returns the triangle's greatest extent along an axis plus one, and what rounding may do to the
    products that `bounds` compares; both in voxels.
    """
    size, far = 1.0, 0.0
    for q in range(3):
        for n in range(3):
            corners[n, q] = (triangle[n, q] - origin[q]) / voxel_m - 0.5
            far = max(far, abs(triangle[n, q]) + abs(origin[q]))
        low, high = _extent(corners, q)
        size = max(size, high - low + 1.0)
    return size, 1e-14 * size * (far / voxel_m + 1.0)


@kernel
def _extent(corners, axis):
    """Least and greatest coordinate along an axis."""
    a, b, c = corners[0, axis], corners[1, axis], corners[2, axis]
    return min(a, b, c), max(a, b, c)


@kernel
def bounds(corners, p, q, first, end, half, slack, spare, noise, found):
    """Fill `found` (4, n): where along axis q a square of the plane p, q has its centre when its
    place along p is a number from `first` to `end` and no edge, and no side of the bounding box,
    has the triangle more than `slack` apart from it. All in voxels, see `numbered`.

    Rows are the least place that may do so, the least and the greatest that surely do, and the
    greatest that may: between them lie `spare`, and `noise` for rounding.
    """
    wide = half + slack
    low, high = _extent(corners, p)
    low_q, high_q = _extent(corners, q)
    for n in range(first, end):
        sure = low - wide + spare < n < high + wide - spare
        found[0, n], found[3, n] = low_q - wide - spare, high_q + wide + spare
        found[1, n] = low_q - wide + spare if sure else math.inf
        found[2, n] = high_q + wide - spare if sure else -math.inf
    for e in range(3):
        a, b, c = e, (e + 1) % 3, (e + 2) % 3
        d, h = corners[b, p] - corners[a, p], corners[b, q] - corners[a, q]
        if d == 0.0 and h == 0.0:  # seen along itself, an edge is a point, and parts nothing
            continue
        if d < 0.0:  # walked the other way, the edge is the same
            a, b, d, h = b, a, -d, -h
        length, pace = math.sqrt(d * d + h * h), 1.0 / max(d, 1e-300)
        reach, doubt = half * (d + abs(h)) + slack * length, spare * length + noise
        edge_0 = corners[a, q] * d - corners[a, p] * h
        corner_0 = corners[c, q] * d - corners[c, p] * h
        below, above = min(edge_0, corner_0) - reach, max(edge_0, corner_0) + reach
        for n in range(first, end):
            least, most = below + n * h, above + n * h
            found[0, n] = max(found[0, n], (least - doubt) * pace)
            found[1, n] = max(found[1, n], (least + doubt) * pace)
            found[2, n] = min(found[2, n], (most - doubt) * pace)
            found[3, n] = min(found[3, n], (most + doubt) * pace)


@kernel
def triangle_distance(a, b, c, x, y, z):
    """Distance in metres from the point (x, y, z) to the triangle abc (Ericson 2005, section
    5.1.5)."""
    abx, aby, abz = joining(a, b)
    acx, acy, acz = joining(a, c)
    point = (x, y, z)
    px, py, pz = joining(a, point)
    d1, d2 = abx * px + aby * py + abz * pz, acx * px + acy * py + acz * pz
    qx, qy, qz = joining(b, point)
    d3, d4 = abx * qx + aby * qy + abz * qz, acx * qx + acy * qy + acz * qz
    rx, ry, rz = joining(c, point)
    d5, d6 = abx * rx + aby * ry + abz * rz, acx * rx + acy * ry + acz * rz
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        s, t = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        s, t = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        s, t = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s, t = d1 / (d1 - d3), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        s, t = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = 1.0 - t
    else:
        total = va + vb + vc
        s, t = vb / total, vc / total
    dx, dy, dz = px - s * abx - t * acx, py - s * aby - t * acy, pz - s * abz - t * acz
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@kernel
def side(a, b, x, y):
    """On which side of the line ab, seen from above, (x, y) lies: +1 left, -1 right, 0 only where a
    and b are one point.

    The two triangles at an edge must agree, so the ends are put in order first, and a point right
    on the line counts as moved by (e, e^2) with an infinitely small e > 0.
    """
    px, py, qx, qy = a[0], a[1], b[0], b[1]
    swap = px > qx or (px == qx and py > qy)
    if swap:
        px, py, qx, qy = qx, qy, px, py
    dx, dy = qx - px, qy - py
    area = dx * (y - py) - dy * (x - px)
    if area == 0.0:
        area = -dy if dy != 0.0 else dx
        if area == 0.0:
            return 0
    left = area > 0.0
    return 1 if left != swap else -1


@kernel
def crossing(a, b, c, x, y):
    """How the vertical line at (x, y) crosses the triangle abc: +1 upwards out of it seen with its
    normal, -1 down into it, 0 not at all; and the height of the crossing."""
    s = side(a, b, x, y)
    if s != side(b, c, x, y) or s != side(c, a, x, y):
        return 0, 0.0
    return s, height_over(a, b, c, x, y)


@kernel
def height_over(a, b, c, x, y):
    """Where the vertical line at (x, y), which crosses the triangle abc, does so."""
    ux, uy, uz = joining(a, b)
    vx, vy, vz = joining(a, c)
    normal_z = ux * vy - uy * vx
    if normal_z == 0.0:
        return max(a[2], b[2], c[2])
    slope_x, slope_y = (uy * vz - uz * vy) / normal_z, (uz * vx - ux * vz) / normal_z
    height = a[2] - slope_x * (x - a[0]) - slope_y * (y - a[1])
    return min(max(height, min(a[2], b[2], c[2])), max(a[2], b[2], c[2]))
