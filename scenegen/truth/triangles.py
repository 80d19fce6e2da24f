"""Triangles: contact with a cube, distance to a point, and crossings with a vertical line."""

import math

from lidarsim.jit import kernel
from lidarsim.solids import joining


@kernel
def triangle_touches(a, b, c, x, y, z, half, slack):
    """Test whether a closed cube comes near a triangle, by separating axes (Akenine-Moller 2001).

    These are the triangle's normal, the cube's faces, and the products of their edges, which are
    tests in the three planes of the axes.

    Args:
        a, b, c: The triangle's corners, (3,) each, metres.
        x, y, z: The cube's centre, metres.
        half: Half its edge, metres.
        slack: How near counts as touching, metres.

    Returns:
        Whether it touches.
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
    # the faces came first, for they are the cheapest
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    # the cube's extent along the normal, which is not of unit length
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
    """Test whether no edge of a triangle in a plane parts it from the square about the origin.

    Args:
        ax, ay, bx, by, cx, cy: The triangle's corners, metres.
        half: Half the square's edge, metres.
        slack: How near counts as touching, metres.

    Returns:
        False if an edge has them more than `slack` apart.
    """
    return not (
        _apart(ax, ay, bx, by, cx, cy, half, slack)
        or _apart(bx, by, cx, cy, ax, ay, half, slack)
        or _apart(cx, cy, ax, ay, bx, by, half, slack)
    )


@kernel
def _apart(ax, ay, bx, by, cx, cy, half, slack):
    """Test whether the line of the edge ab has the triangle on one side and the square on the
    other."""
    dx, dy = bx - ax, by - ay
    reach = half * (abs(dx) + abs(dy)) + slack * math.sqrt(dx * dx + dy * dy)
    edge, corner = ay * dx - ax * dy, cy * dx - cx * dy
    # rounding leaves an edge through the square's only point within reach
    reach += 1e-14 * (abs(ay * dx) + abs(ax * dy) + abs(cy * dx) + abs(cx * dy))
    return min(edge, corner) > reach or max(edge, corner) < -reach


@kernel
def numbered(triangle, origin, voxel_m, corners):
    """Count a triangle's coordinates in voxels from the centre of the first voxel.

    Args:
        triangle: (3, 3), metres.
        origin: (3,): the grid's least corner, metres.
        voxel_m: Edge of a voxel, metres.
        corners: The result, (3, 3).

    Returns:
        The triangle's greatest extent along an axis plus one; and the rounding error of the
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
    """Return least and greatest coordinate along an axis."""
    a, b, c = corners[0, axis], corners[1, axis], corners[2, axis]
    return min(a, b, c), max(a, b, c)


@kernel
def bounds(corners, p, q, first, end, half, slack, spare, noise, limits):
    """Bound where a square touches a triangle in the plane of two axes.

    For each place along axis p, the square may move along axis q. It touches unless an edge, or a
    side of the bounding box, has the triangle more than `slack` apart from it. All in voxels, see
    `numbered`.

    Args:
        corners: (3, 3), from `numbered`.
        p, q: The axes.
        first, end: The places along p.
        half: Half the square's edge.
        slack: How near counts as touching.
        spare: The margin within which nothing is sure.
        noise: The rounding error.
        limits: The result, (4, n): along q, the least place that may touch, the least and the
            greatest that surely do, and the greatest that may.
    """
    wide = half + slack
    low, high = _extent(corners, p)
    low_q, high_q = _extent(corners, q)
    for n in range(first, end):
        # the sides of the bounding box first, then each edge tightens the bounds
        sure = low - wide + spare < n < high + wide - spare
        limits[0, n], limits[3, n] = low_q - wide - spare, high_q + wide + spare
        limits[1, n] = low_q - wide + spare if sure else math.inf
        limits[2, n] = high_q + wide - spare if sure else -math.inf
    for e in range(3):
        a, b, c = e, (e + 1) % 3, (e + 2) % 3
        d, h = corners[b, p] - corners[a, p], corners[b, q] - corners[a, q]
        if d == 0.0 and h == 0.0:  # seen along itself, an edge is a point, and parts nothing
            continue
        if d < 0.0:  # walked the other way, the edge is the same
            a, b, d, h = b, a, -d, -h
        # an edge along q has an infinite pace; 1e300 spares the NaN of 0 times infinity
        length, pace = math.sqrt(d * d + h * h), 1.0 / max(d, 1e-300)
        reach, doubt = half * (d + abs(h)) + slack * length, spare * length + noise
        edge_0 = corners[a, q] * d - corners[a, p] * h
        corner_0 = corners[c, q] * d - corners[c, p] * h
        # heights of the two lines parallel to the edge, times d, at place 0
        below, above = min(edge_0, corner_0) - reach, max(edge_0, corner_0) + reach
        for n in range(first, end):
            lowest, highest = below + n * h, above + n * h
            limits[0, n] = max(limits[0, n], (lowest - doubt) * pace)
            limits[1, n] = max(limits[1, n], (lowest + doubt) * pace)
            limits[2, n] = min(limits[2, n], (highest - doubt) * pace)
            limits[3, n] = min(limits[3, n], (highest + doubt) * pace)


@kernel
def triangle_distance(a, b, c, x, y, z):
    """Compute the distance from a point to a triangle (Ericson 2005, section 5.1.5).

    Args:
        a, b, c: The triangle's corners, (3,) each, metres.
        x, y, z: The point, metres.

    Returns:
        Metres.
    """
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
    # the nearest feature: corners a, b, c, edges ab, ac, bc, or the inside, as a + s ab + t ac
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
    """Tell on which side of a line, seen from above, a point lies.

    The two triangles at an edge must agree, so the ends are put in order first, and a point right
    on the line counts as moved by (e, e^2) with an infinitely small e > 0.

    Args:
        a, b: Two points of the line, x and y first.
        x, y: The point.

    Returns:
        +1 left, -1 right, 0 only if a and b have the same x and y.
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
    # an edge walked the other way has its left where the right was
    left = area > 0.0
    return 1 if left != swap else -1


@kernel
def crossing(a, b, c, x, y):
    """Tell how a vertical line crosses a triangle.

    Args:
        a, b, c: The triangle's corners, (3,) each, metres.
        x, y: The line's place, metres.

    Returns:
        +1 if its normal points up at the crossing, -1 if down, 0 without a crossing; and the height
        of the crossing, metres.
    """
    s = side(a, b, x, y)
    # inside if it lies on the same side of all three edges
    if s != side(b, c, x, y) or s != side(c, a, x, y):
        return 0, 0.0
    return s, height_over(a, b, c, x, y)


@kernel
def height_over(a, b, c, x, y):
    """Compute where a vertical line crosses a triangle.

    Args:
        a, b, c: The triangle's corners, (3,) each, metres.
        x, y: The line's place, metres; it must cross the triangle.

    Returns:
        The height, metres.
    """
    ux, uy, uz = joining(a, b)
    vx, vy, vz = joining(a, c)
    normal_z = ux * vy - uy * vx
    # a vertical triangle has no single height there
    if normal_z == 0.0:
        return max(a[2], b[2], c[2])
    slope_x, slope_y = (uy * vz - uz * vy) / normal_z, (uz * vx - ux * vz) / normal_z
    height = a[2] - slope_x * (x - a[0]) - slope_y * (y - a[1])
    # rounding in steep triangles must not lead beyond their corners
    return min(max(height, min(a[2], b[2], c[2])), max(a[2], b[2], c[2]))
