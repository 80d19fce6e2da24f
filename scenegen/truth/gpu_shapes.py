"""Whether a cube touches a shape, in Warp: `scenegen.truth.shapes` and `triangles` again, sum by
sum in their order.

Cubes and frames are theirs: the centre in the shape's frame, the world's axes there as rows of
`axes`, half an edge.
"""

import numpy as np

from lidarsim.gpu.device import wp
from lidarsim.solids.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, SPHERE

INF = wp.constant(wp.float64(np.inf))
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
LEVEL = wp.constant(wp.float64(1e-15))
FLAT = wp.constant(wp.float64(1e-24))
PARALLEL = wp.constant(wp.float64(1e-12))
ROOTED = wp.constant(wp.float64(1e-14))


@wp.func
def distance(shape: wp.int32, size: wp.vec3d, p: wp.vec3d) -> wp.float64:
    """Distance in metres from the point p to the filled shape; 0 inside. A plane fills z <= 0."""
    if shape == SPHERE:
        return wp.max(wp.length(p) - size[0], ZERO)
    if shape == CAPSULE:
        z = p[2] - wp.min(wp.max(p[2], -size[1]), size[1])
        return wp.max(wp.length(wp.vec3d(p[0], p[1], z)) - size[0], ZERO)
    if shape == CYLINDER:
        radial = wp.max(wp.sqrt(p[0] * p[0] + p[1] * p[1]) - size[0], ZERO)
        axial = wp.max(wp.abs(p[2]) - size[1], ZERO)
        return wp.sqrt(radial * radial + axial * axial)
    if shape == BOX:
        return wp.length(wp.max(wp.abs(p) - size, wp.vec3d()))
    if shape == ELLIPSOID:
        return _ellipsoid_distance(size, p)
    return wp.max(p[2], ZERO)


@wp.func
def _ellipsoid_distance(size: wp.vec3d, p: wp.vec3d) -> wp.float64:
    """Newton's method from 0, for a root that it climbs to from the left (Eberly)."""
    square = wp.cw_mul(size, size)
    weight = wp.cw_mul(wp.cw_mul(square, p), p)
    t = wp.float64(0.0)
    for _ in range(100):
        beyond = wp.vec3d(t) + square
        u = wp.cw_div(weight, wp.cw_mul(beyond, beyond))
        value = u[0] + u[1] + u[2] - ONE
        if value <= ROOTED:
            break
        v = wp.cw_div(u, beyond)
        t += HALF * value / (v[0] + v[1] + v[2])
    return wp.length(wp.cw_div(t * p, wp.vec3d(t) + square))


@wp.func
def touches(
    shape: wp.int32,
    size: wp.vec3d,
    axes: wp.mat33d,
    p: wp.vec3d,
    half: wp.float64,
    slack: wp.float64,
) -> wp.bool:
    """Whether the closed cube about p comes within `slack` metres of the filled shape."""
    reach = size[0] + slack
    if shape == SPHERE:
        return _point_to_cube2(axes, p, half) <= reach * reach
    if shape == CAPSULE:
        return _segment_to_cube2(axes, p, size[1], half) <= reach * reach
    if shape == CYLINDER:
        return _cylinder_touches(reach, size[1] + slack, axes, p, half)
    if shape == BOX:
        return _box_touches(size, axes, p, half, slack)
    if shape == ELLIPSOID:
        return _ellipsoid_touches(size, axes, p, half, slack)
    return p[2] - half * (wp.abs(axes[0, 2]) + wp.abs(axes[1, 2]) + wp.abs(axes[2, 2])) <= slack


@wp.func
def _point_to_cube2(axes: wp.mat33d, p: wp.vec3d, half: wp.float64) -> wp.float64:
    """Squared distance from the frame's origin to the cube."""
    return wp.length_sq(wp.max(wp.abs(axes * p) - wp.vec3d(half), wp.vec3d()))


@wp.func
def _segment_to_cube2(
    axes: wp.mat33d, p: wp.vec3d, reach: wp.float64, half: wp.float64
) -> wp.float64:
    """Squared distance from the segment |z| <= reach of the frame's z axis to the cube: a convex
    function along it, of which the kinks around its derivative's root are found, then the root."""
    low, high = -reach, wp.float64(reach)
    slope_low = _segment_slope(axes, p, low, half)
    slope_high = _segment_slope(axes, p, high, half)
    if slope_low >= ZERO:
        return _point_to_cube2(axes, wp.vec3d(p[0], p[1], p[2] - low), half)
    if slope_high <= ZERO:
        return _point_to_cube2(axes, wp.vec3d(p[0], p[1], p[2] - high), half)
    centre = axes * p
    for a in range(3):
        if axes[a, 2] != ZERO:
            for side in range(2):
                t = (centre[a] + (half if side == 1 else -half)) / axes[a, 2]
                if low < t and t < high:
                    slope = _segment_slope(axes, p, t, half)
                    if slope <= ZERO:
                        low = t
                        slope_low = slope
                    else:
                        high = t
                        slope_high = slope
    if slope_high > slope_low:
        low -= slope_low * (high - low) / (slope_high - slope_low)
    return _point_to_cube2(axes, wp.vec3d(p[0], p[1], p[2] - low), half)


@wp.func
def _segment_slope(axes: wp.mat33d, p: wp.vec3d, t: wp.float64, half: wp.float64) -> wp.float64:
    """Half the derivative, at height t of the segment, of the squared distance to the cube."""
    total = wp.float64(0.0)
    centre = axes * p
    for a in range(3):
        offset = axes[a, 2] * t - centre[a]
        if offset > half:
            total += (offset - half) * axes[a, 2]
        elif offset < -half:
            total += (offset + half) * axes[a, 2]
    return total


@wp.func
def _box_touches(
    size: wp.vec3d, axes: wp.mat33d, p: wp.vec3d, half: wp.float64, slack: wp.float64
) -> wp.bool:
    """Separating axes (Gottschalk 1996): the 3 faces of each box and the 9 products of their
    edges."""
    for b in range(3):
        shadow = wp.abs(axes[0, b]) + wp.abs(axes[1, b]) + wp.abs(axes[2, b])
        if wp.abs(p[b]) > size[b] + half * shadow + slack:
            return False
    for a in range(3):
        gap = wp.abs(axes[a, 0] * p[0] + axes[a, 1] * p[1] + axes[a, 2] * p[2])
        x, y, z = (
            wp.abs(axes[a, 0]) * size[0],
            wp.abs(axes[a, 1]) * size[1],
            wp.abs(axes[a, 2]) * size[2],
        )
        if gap > half + x + y + z + slack:
            return False
    for a in range(3):
        e, f = (a + 1) % 3, (a + 2) % 3
        for b in range(3):
            c, d = (b + 1) % 3, (b + 2) % 3
            length2 = ONE - axes[a, b] * axes[a, b]
            if length2 > PARALLEL:
                gap = wp.abs(p[d] * axes[a, c] - p[c] * axes[a, d])
                own = size[c] * wp.abs(axes[a, d]) + size[d] * wp.abs(axes[a, c])
                if gap > own + half * (wp.abs(axes[e, b]) + wp.abs(axes[f, b])) + slack * wp.sqrt(
                    length2
                ):
                    return False
    return True


@wp.func
def _ellipsoid_touches(
    size: wp.vec3d, axes: wp.mat33d, p: wp.vec3d, half: wp.float64, slack: wp.float64
) -> wp.bool:
    """In the space where the ellipsoid is the unit ball, the nearest point of the parallelepiped
    that the cube becomes, among its faces and edges."""
    if _point_to_cube2(axes, p, half) == ZERO:
        return True
    scale = wp.vec3d(ONE / size[0], ONE / size[1], ONE / size[2])
    centre = wp.cw_mul(p, scale)
    nearest = wp.vec3d()
    least = wp.float64(INF)
    for i in range(3):  # every edge along half edge i, and the faces that the other two span
        mi = wp.cw_mul(half * axes[i], scale)
        mj = wp.cw_mul(half * axes[(i + 1) % 3], scale)
        mk = wp.cw_mul(half * axes[(i + 2) % 3], scale)
        ii, jj, kk, jk = wp.dot(mi, mi), wp.dot(mj, mj), wp.dot(mk, mk), wp.dot(mj, mk)
        for one in range(2):
            s = wp.float64(2 * one - 1)
            u = centre + s * mi
            ju, ku = wp.dot(mj, u), wp.dot(mk, u)
            det = jj * kk - jk * jk
            g, h = (jk * ku - kk * ju) / det, (jk * ju - jj * ku) / det
            if wp.abs(g) <= ONE and wp.abs(h) <= ONE:
                at = u + g * mj + h * mk
                if wp.dot(at, at) < least:
                    nearest = at
                    least = wp.dot(at, at)
            for other in range(2):
                corner = centre + s * mj + wp.float64(2 * other - 1) * mk
                along = wp.min(wp.max(-wp.dot(mi, corner) / ii, -ONE), ONE)
                on = corner + along * mi
                if wp.dot(on, on) < least:
                    nearest = on
                    least = wp.dot(on, on)
    if least <= ONE:
        return True
    f = wp.sqrt(least)
    return (f - ONE) * f <= slack * wp.length(wp.cw_mul(nearest, scale))


@wp.func
def _cylinder_touches(
    radius: wp.float64, reach: wp.float64, axes: wp.mat33d, p: wp.vec3d, half: wp.float64
) -> wp.bool:
    """Whether the axis runs through the cube between the end planes, or an edge of that part of the
    cube passes the axis within the radius."""
    enter, leave = -reach, wp.float64(reach)
    centre = axes * p
    for a in range(3):  # the axis, as a segment, against the cube's slabs
        if wp.abs(axes[a, 2]) > LEVEL:
            s, t = (-half + centre[a]) / axes[a, 2], (half + centre[a]) / axes[a, 2]
            enter = wp.max(enter, wp.min(s, t))
            leave = wp.min(leave, wp.max(s, t))
        elif wp.abs(centre[a]) > half:
            leave = -INF
    if enter <= leave:
        return True
    limit = radius * radius
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for corner in range(4):
            sj, sk = half if corner // 2 == 1 else -half, half if corner % 2 == 1 else -half
            c = p + sj * axes[j] + sk * axes[k]
            low, high = -half, wp.float64(half)
            if wp.abs(axes[i, 2]) > LEVEL:
                s, t = (-reach - c[2]) / axes[i, 2], (reach - c[2]) / axes[i, 2]
                low = wp.max(low, wp.min(s, t))
                high = wp.min(high, wp.max(s, t))
            elif wp.abs(c[2]) > reach:
                high = -INF
            if low <= high and _segment_norm2(c + low * axes[i], c + high * axes[i]) <= limit:
                return True
    for plane in range(2):
        height = reach if plane == 1 else -reach
        for face in range(6):
            if (
                _face_cut_norm2(axes, p, face // 2, half if face % 2 == 1 else -half, height, half)
                <= limit
            ):
                return True
    return False


@wp.func
def _segment_norm2(p: wp.vec3d, q: wp.vec3d) -> wp.float64:
    """Squared distance, seen along z, from the origin to the segment pq."""
    dx, dy = q[0] - p[0], q[1] - p[1]
    length2 = dx * dx + dy * dy
    t = wp.float64(0.0)
    if length2 > ZERO:
        t = wp.min(wp.max(-(p[0] * dx + p[1] * dy) / length2, ZERO), ONE)
    x, y = p[0] + t * dx, p[1] + t * dy
    return x * x + y * y


@wp.func
def _face_cut_norm2(
    axes: wp.mat33d,
    p: wp.vec3d,
    i: wp.int32,
    side: wp.float64,
    height: wp.float64,
    half: wp.float64,
) -> wp.float64:
    """Squared distance from the axis to the segment in which the plane z = height cuts the face at
    `side` along axis i; inf if it does not."""
    e, f = axes[(i + 1) % 3], axes[(i + 2) % 3]
    c = p + side * axes[i]
    above = c[2] - height
    u, v = e[2], f[2]
    norm2 = u * u + v * v
    if norm2 < FLAT:
        return INF
    # the points above + u g + v h = 0 of the face's plane, walked along (-v, u) from the one
    # nearest to its centre
    g, h = -above * u / norm2, -above * v / norm2
    low, high = -INF, wp.float64(INF)
    if v != ZERO:
        s, t = (g - half) / v, (g + half) / v
        low = wp.max(low, wp.min(s, t))
        high = wp.min(high, wp.max(s, t))
    elif wp.abs(g) > half:
        return INF
    if u != ZERO:
        s, t = (-half - h) / u, (half - h) / u
        low = wp.max(low, wp.min(s, t))
        high = wp.min(high, wp.max(s, t))
    elif wp.abs(h) > half:
        return INF
    if low > high:
        return INF
    return _segment_norm2(
        c + (g - low * v) * e + (h + low * u) * f, c + (g - high * v) * e + (h + high * u) * f
    )


@wp.func
def triangle_touches(
    a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, centre: wp.vec3d, half: wp.float64, slack: wp.float64
) -> wp.bool:
    """Whether the closed cube about `centre` comes within `slack` metres of the triangle abc
    (Akenine-Moller 2001)."""
    p = wp.matrix_from_rows(a - centre, b - centre, c - centre)
    low, high = wp.min(wp.min(p[0], p[1]), p[2]), wp.max(wp.max(p[0], p[1]), p[2])
    for i in range(3):
        if low[i] > half + slack or high[i] < -half - slack:
            return False
    n = wp.cross(p[1] - p[0], p[2] - p[0])
    if wp.abs(wp.dot(n, p[0])) > half * (
        wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2])
    ) + slack * wp.length(n):
        return False
    for e in range(3):
        edge = p[(e + 1) % 3] - p[e]
        for i in range(
            3
        ):  # the axis is unit vector i x edge: components j, k of the edge, swapped, one negated
            j, k = (i + 1) % 3, (i + 2) % 3
            q0 = p[0, k] * edge[j] - p[0, j] * edge[k]
            q1 = p[1, k] * edge[j] - p[1, j] * edge[k]
            q2 = p[2, k] * edge[j] - p[2, j] * edge[k]
            reach = half * (wp.abs(edge[j]) + wp.abs(edge[k]))
            reach += slack * wp.sqrt(edge[j] * edge[j] + edge[k] * edge[k])
            if wp.min(wp.min(q0, q1), q2) > reach or wp.max(wp.max(q0, q1), q2) < -reach:
                return False
    return True


@wp.func
def crossing(
    a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, x: wp.float64, y: wp.float64
) -> tuple[wp.int32, wp.float64]:
    """How the vertical line at (x, y) crosses the triangle abc: +1 upwards out of it seen with its
    normal, -1 down into it, 0 not at all; and the height of the crossing."""
    s = _side(a, b, x, y)
    if s != _side(b, c, x, y) or s != _side(c, a, x, y):
        return 0, ZERO
    n = wp.cross(b - a, c - a)
    top = wp.max(wp.max(a[2], b[2]), c[2])
    if n[2] == ZERO:
        return s, top
    height = a[2] - n[0] / n[2] * (x - a[0]) - n[1] / n[2] * (y - a[1])
    return s, wp.min(wp.max(height, wp.min(wp.min(a[2], b[2]), c[2])), top)


@wp.func
def _side(a: wp.vec3d, b: wp.vec3d, x: wp.float64, y: wp.float64) -> wp.int32:
    """On which side of the line ab, seen from above, (x, y) lies: +1 left, -1 right, never 0. The
    two triangles at an edge agree, for its ends are put in order first, and a point right on it
    counts as moved a little."""
    swap = a[0] > b[0] or (a[0] == b[0] and a[1] > b[1])
    p, q = a, b
    if swap:
        p = b
        q = a
    dx, dy = q[0] - p[0], q[1] - p[1]
    area = dx * (y - p[1]) - dy * (x - p[0])
    if area == ZERO:
        area = -dy if dy != ZERO else dx
    return 1 if (area > ZERO) != swap else -1
