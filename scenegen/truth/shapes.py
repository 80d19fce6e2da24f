"""Closed forms of MuJoCo's primitive shapes, in the shape's frame: distance to a point, contact
with a cube, and whether a cube is inside.

A cube has a centre, three unit axes (the world's axes written in the shape's frame, so row a of the
shape's rotation matrix is axis a) and half an edge. Sizes are MuJoCo's: (radius), (radius, half
length), half edges or semi-axes. `slack` is the distance at which a cube still counts as touching.

Whether solid and cube meet is decided to rounding. At a distance, corners and edges count up to the
root of three times `slack`, and ellipsoids up to 1.3 times, if their least radius of curvature
(least semi-axis squared over the greatest) is at least `slack`; for thinner ones, some cubes that
are farther away count as touching."""

import math

import numpy as np

from lidarsim.jit import kernel
from lidarsim.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID, SPHERE


@kernel
def _along(rows, n, v):
    """Multiply row n with a vector."""
    return rows[n, 0] * v[0] + rows[n, 1] * v[1] + rows[n, 2] * v[2]


@kernel
def _square(v):
    """Return a vector's squared length."""
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


@kernel
def moved(point, rows, n, t):
    """Move a point along a row of a matrix.

    Args:
        point: (3,).
        rows: (3, 3).
        n: The row's number.
        t: The factor.

    Returns:
        x, y, z of the moved point.
    """
    return point[0] + t * rows[n, 0], point[1] + t * rows[n, 1], point[2] + t * rows[n, 2]


@kernel
def distance(shape, size, x, y, z):
    """Compute the distance from a point to a filled shape. A plane fills z <= 0.

    Args:
        shape: Its code.
        size: (3,), metres.
        x, y, z: The point in the shape's frame, metres.

    Returns:
        Metres; 0 inside.
    """
    if shape == SPHERE:
        return max(math.sqrt(x * x + y * y + z * z) - size[0], 0.0)
    if shape == CAPSULE:
        z -= min(max(z, -size[1]), size[1])
        return max(math.sqrt(x * x + y * y + z * z) - size[0], 0.0)
    if shape == CYLINDER:
        radial, axial = max(math.sqrt(x * x + y * y) - size[0], 0.0), max(abs(z) - size[1], 0.0)
        return math.sqrt(radial * radial + axial * axial)
    if shape == BOX:
        x, y, z = max(abs(x) - size[0], 0.0), max(abs(y) - size[1], 0.0), max(abs(z) - size[2], 0.0)
        return math.sqrt(x * x + y * y + z * z)
    if shape == ELLIPSOID:
        return _ellipsoid_distance(size, x, y, z)
    return max(z, 0.0)


@kernel
def _ellipsoid_distance(size, x, y, z):
    """Find the nearest point of an ellipsoid by Newton's method.

    It is (a² x / (t + a²), ...) with t > 0 the root of a convex, falling function (Eberly,
    "Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid"). From 0, Newton's
    method climbs to the root from the left without overshooting."""
    a, b, c = size[0] * size[0], size[1] * size[1], size[2] * size[2]
    p, q, r = a * x * x, b * y * y, c * z * z
    t = 0.0
    for _ in range(100):
        u, v, w = p / ((t + a) * (t + a)), q / ((t + b) * (t + b)), r / ((t + c) * (t + c))
        value = u + v + w - 1.0
        # rounding of the sum; points inside end here at t = 0
        if value <= 1e-14:
            break
        t += 0.5 * value / (u / (t + a) + v / (t + b) + w / (t + c))
    x, y, z = t * x / (t + a), t * y / (t + b), t * z / (t + c)
    return math.sqrt(x * x + y * y + z * z)


@kernel
def touches(shape, size, axes, centre, half, slack):
    """Test whether a closed cube touches a filled shape.

    Args:
        shape: Its code.
        size: (3,), metres.
        axes: (3, 3): the cube's axes in rows.
        centre: (3,): the cube's centre in the shape's frame, metres.
        half: Half its edge, metres.
        slack: How near counts as touching, metres.

    Returns:
        Whether it touches; valid only if the cube touches the shape's bounding box.
    """
    reach = size[0] + slack
    if shape == SPHERE:
        return _point_to_cube2(axes, centre, half) <= reach * reach
    if shape == CAPSULE:
        return _segment_to_cube2(axes, centre, size[1], half) <= reach * reach
    if shape == CYLINDER:
        return _cylinder_touches(reach, size[1] + slack, axes, centre, half)
    if shape == BOX:
        return _box_touches(size, axes, centre, half, slack)
    if shape == ELLIPSOID:
        return _ellipsoid_touches(size, axes, centre, half, slack)
    # a plane: the cube's lowest corner decides
    return centre[2] - half * (abs(axes[0, 2]) + abs(axes[1, 2]) + abs(axes[2, 2])) <= slack


@kernel
def within(shape, size, axes, centre, half, slack):
    """Test whether a closed cube lies deep in a shape.

    The shapes are convex, and so is their part at that depth: the cube's corners decide.

    Args:
        shape, size, axes, centre, half: As for `touches`.
        slack: The depth below the surface, metres.

    Returns:
        Whether all of the cube is deeper than `slack`.
    """
    for i in (-half, half):
        face = moved(centre, axes, 0, i)
        for j in (-half, half):
            edge = moved(face, axes, 1, j)
            for k in (-half, half):
                u, v, w = moved(edge, axes, 2, k)
                if not _is_deep(shape, size, u, v, w, slack):
                    return False
    return True


@kernel
def _is_deep(shape, size, x, y, z, slack):
    """Test whether a point lies in the shape, deeper than `slack`.

    In an ellipsoid, the depth is underestimated by that along the least semi-axis."""
    if shape == CAPSULE:
        z -= min(max(z, -size[1]), size[1])
    if shape in (SPHERE, CAPSULE):
        return math.sqrt(x * x + y * y + z * z) < size[0] - slack
    if shape == CYLINDER:
        return math.sqrt(x * x + y * y) < size[0] - slack and abs(z) < size[1] - slack
    if shape == BOX:
        return abs(x) < size[0] - slack and abs(y) < size[1] - slack and abs(z) < size[2] - slack
    if shape == ELLIPSOID:
        x, y, z = x / size[0], y / size[1], z / size[2]
        return (1.0 - math.sqrt(x * x + y * y + z * z)) * min(size[0], size[1], size[2]) > slack
    return z < -slack


@kernel
def _point_to_cube2(axes, centre, half):
    """Return the squared distance from the frame's origin to the cube."""
    total = 0.0
    for a in range(3):
        gap = max(abs(_along(axes, a, centre)) - half, 0.0)
        # along the cube's own axes, it is a box
        total += gap * gap
    return total


@kernel
def _segment_to_cube2(axes, centre, reach, half):
    """Return the squared distance from the segment |z| <= reach of the frame's z axis to the cube.

    Along the segment the squared distance is convex and piecewise quadratic; its derivative is
    piecewise linear with a kink where the segment crosses a face's plane. The kinks around the
    derivative's root are found, then the root."""
    low, high = -reach, reach
    slope_low = _segment_slope(axes, centre, low, half)
    slope_high = _segment_slope(axes, centre, high, half)
    # convex: where it already rises at the low end, that end is nearest, and so at the other
    if slope_low >= 0.0:
        high = low
    elif slope_high <= 0.0:
        low = high
    for a in range(3):
        if low < high and axes[a, 2] != 0.0:
            middle = _along(axes, a, centre)
            for side in (-half, half):
                t = (middle + side) / axes[a, 2]
                if low < t < high:
                    slope = _segment_slope(axes, centre, t, half)
                    if slope <= 0.0:
                        low, slope_low = t, slope
                    else:
                        high, slope_high = t, slope
    # between two kinks the derivative is linear
    if slope_high > slope_low:
        low -= slope_low * (high - low) / (slope_high - slope_low)
    nearest = (centre[0], centre[1], centre[2] - low)
    return _point_to_cube2(axes, nearest, half)


@kernel
def _segment_slope(axes, centre, t, half):
    """Return half the derivative by t of the squared distance from the point (0, 0, t) to the
    cube."""
    total = 0.0
    for a in range(3):
        offset = axes[a, 2] * t - _along(axes, a, centre)
        if offset > half:
            total += (offset - half) * axes[a, 2]
        elif offset < -half:
            total += (offset + half) * axes[a, 2]
    return total


@kernel
def _box_touches(size, axes, centre, half, slack):
    """Test separating axes (Gottschalk 1996): the box's 3 faces and 9 products of edges.

    The cube's faces part it from no box whose bounding box it touches."""
    for b in range(3):
        if (
            abs(centre[b])
            > size[b] + half * (abs(axes[0, b]) + abs(axes[1, b]) + abs(axes[2, b])) + slack
        ):
            return False
    for a in range(3):
        e, f = axes[(a + 1) % 3], axes[(a + 2) % 3]
        for b in range(3):
            c, d = (b + 1) % 3, (b + 2) % 3
            # the product's squared length; parallel edges give none
            length2 = 1.0 - axes[a, b] * axes[a, b]
            if length2 > 1e-12:
                gap = abs(centre[d] * axes[a, c] - centre[c] * axes[a, d])
                reach = (
                    size[c] * abs(axes[a, d])
                    + size[d] * abs(axes[a, c])
                    + half * (abs(e[b]) + abs(f[b]))
                )
                if gap > reach + slack * math.sqrt(length2):
                    return False
    return True


@kernel
def _ellipsoid_touches(size, axes, centre, half, slack):
    """Test a cube against an ellipsoid, scaled so that it is the unit ball.

    The cube is then a parallelepiped, whose point nearest to the centre is found among the
    interiors of its faces and edges. There, the gap is at least (f - 1) / |grad f| with f the
    scaled length (f is convex), and equals it to first order."""
    # the cube holds the ellipsoid's centre
    if _point_to_cube2(axes, centre, half) == 0.0:
        return True
    a, b, c = 1.0 / size[0], 1.0 / size[1], 1.0 / size[2]
    middle = (centre[0] * a, centre[1] * b, centre[2] * c)  # scaled
    m = np.empty((3, 3))  # the scaled half edges
    for i in range(3):
        m[i, 0] = half * axes[i, 0] * a
        m[i, 1] = half * axes[i, 1] * b
        m[i, 2] = half * axes[i, 2] * c
    least2, nearest = math.inf, middle
    for i in range(3):  # every edge along half edge i, and the faces that the other two span
        j, k = (i + 1) % 3, (i + 2) % 3
        ii = _along(m, i, m[i])
        jj = _along(m, j, m[j])
        kk = _along(m, k, m[k])
        jk = _along(m, j, m[k])
        for s in (-1.0, 1.0):
            face = moved(middle, m, i, s)
            ju, ku = _along(m, j, face), _along(m, k, face)
            # the foot of the perpendicular in the face's plane; beyond the face, an edge is nearer
            det = jj * kk - jk * jk
            p, q = (jk * ku - kk * ju) / det, (jk * ju - jj * ku) / det
            if abs(p) <= 1.0 and abs(q) <= 1.0:
                point = moved(moved(face, m, j, p), m, k, q)
                if _square(point) < least2:
                    least2, nearest = _square(point), point
            for r in (-1.0, 1.0):
                edge = moved(moved(middle, m, j, s), m, k, r)
                point = moved(edge, m, i, min(max(-_along(m, i, edge) / ii, -1.0), 1.0))
                if _square(point) < least2:
                    least2, nearest = _square(point), point
    if least2 <= 1.0:
        return True
    f = math.sqrt(least2)
    # at a distance: how far in metres, not in the scaled space
    slope = (nearest[0] * a, nearest[1] * b, nearest[2] * c)
    # the gradient of f is slope / f
    return (f - 1.0) * f <= slack * math.sqrt(_square(slope))


@kernel
def _cylinder_touches(radius, reach, axes, centre, half):
    """Test a cube against a cylinder.

    The part of the cube between the cylinder's two end planes is convex, so it touches when its
    shadow along the axis does: when the axis runs through it, or one of its edges (the cube's, cut
    at the planes, and the cuts themselves) passes the axis within the radius."""
    enter, leave = -reach, reach
    for a in range(3):  # the axis, as a segment, against the cube's slabs
        offset = -_along(axes, a, centre)
        enter, leave = _clipped(enter, leave, offset, axes[a, 2], half, 1e-15)
    if enter <= leave:
        return True
    # else an edge comes nearest to the axis
    limit = radius * radius
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for sj in (-half, half):
            for sk in (-half, half):
                edge = moved(moved(centre, axes, j, sj), axes, k, sk)
                low, high = _clipped(-half, half, edge[2], axes[i, 2], reach, 1e-15)
                if low <= high:
                    p, q = moved(edge, axes, i, low), moved(edge, axes, i, high)
                    if _segment_norm2(p, q) <= limit:
                        return True
    for plane in (-reach, reach):
        for i in range(3):  # the cut of the end plane with each of the two faces across axis i
            for si in (-half, half):
                if _face_cut_norm2(axes, centre, i, si, plane, half) <= limit:
                    return True
    return False


@kernel
def _clipped(low, high, offset, slope, reach, flat):
    """Return the part of the interval [low, high] of t with |offset + slope t| <= reach.

    It is [inf, -inf] if empty; a slope of at most `flat` counts as 0."""
    if abs(slope) > flat:
        s, t = (-reach - offset) / slope, (reach - offset) / slope
        return max(low, min(s, t)), min(high, max(s, t))
    if abs(offset) > reach:
        return math.inf, -math.inf
    return low, high


@kernel
def _segment_norm2(p, q):
    """Return the squared distance from the z axis to the segment pq, seen along that axis."""
    px, py, dx, dy = p[0], p[1], q[0] - p[0], q[1] - p[1]
    length2 = dx * dx + dy * dy
    t = min(max(-(px * dx + py * dy) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
    px, py = px + t * dx, py + t * dy
    return px * px + py * py


@kernel
def _face_cut_norm2(axes, centre, i, si, height, half):
    """Return the squared distance from the axis to the segment in which the plane z = height cuts
    one face; inf without a cut."""
    j, k = (i + 1) % 3, (i + 2) % 3
    face = moved(centre, axes, i, si)
    cz = face[2] - height
    u, v = axes[j, 2], axes[k, 2]
    norm2 = u * u + v * v
    # level with the plane, a face has no cut: its edges are looked at by the caller
    if norm2 < 1e-24:
        return math.inf
    # the points cz + u p + v q = 0 of the face's plane, walked along (-v, u) from the one nearest
    # to its centre
    p0, q0 = -cz * u / norm2, -cz * v / norm2
    low, high = _clipped(-math.inf, math.inf, p0, -v, half, 0.0)
    low, high = _clipped(low, high, q0, u, half, 0.0)
    if low > high:
        return math.inf
    p = moved(moved(face, axes, j, p0 - low * v), axes, k, q0 + low * u)
    q = moved(moved(face, axes, j, p0 - high * v), axes, k, q0 + high * u)
    return _segment_norm2(p, q)
