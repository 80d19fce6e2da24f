"""Closed forms: where a ray meets a shape, and the normal there, in the shape's frame as MuJoCo has
it.

A ray that starts inside a solid meets its surface where it comes out, as in MuJoCo."""

import math

import numpy as np

from lidarsim.grid import Floats, Ints
from lidarsim.jit import kernel
from lidarsim.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE, local


@kernel
def meet(shape, a, b, c, px, py, pz, dx, dy, dz):
    """Find the distance along a ray to a shape's surface, in the shape's frame.

    Shapes are convex, so a line is inside between two distances. Those of a shape of several parts
    follow from the parts' own, so that rounding opens no seam between them. Planes: `meet_plane`.

    Args:
        shape: Its code, see `lidarsim.solids`.
        a, b, c: MuJoCo's sizes, metres.
        px, py, pz: Where the ray begins, metres.
        dx, dy, dz: Its direction, a unit vector.

    Returns:
        Metres; inf where the ray misses. From inside, where the ray comes out.
    """
    if shape == BOX:
        enter, leave = _in_box(a, b, c, px, py, pz, dx, dy, dz)
        return _first(enter, leave)
    if shape == SPHERE:
        return meet_ball(px, py, pz, dx, dy, dz, a)
    if shape == ELLIPSOID:  # a stretched unit ball; the direction loses its length
        u, v, w = dx / a, dy / b, dz / c
        length = math.sqrt(u * u + v * v + w * w)
        t = meet_ball(px / a, py / b, pz / c, u / length, v / length, w / length, 1.0)
        return t / length
    enter, leave = _in_cylinder(a, b, px, py, pz, dx, dy, dz)
    if shape == CAPSULE:
        for end in (-b, b):
            near, far = _in_ball(px, py, pz - end, dx, dy, dz, a)
            enter, leave = min(enter, near), max(leave, far)
    return _first(enter, leave)


@kernel
def meet_plane(g, size, rotation, sx, sy, sz, x, y, z):
    """Find the distance to a plane, seen from above and within its half sizes where these are not
    0.

    Args:
        g: The plane's number among primitives.
        size: (n, 3): half sizes along x and y, metres.
        rotation: (n, 3, 3).
        sx, sy, sz: Where the ray begins, relative to the plane's centre, world axes, metres.
        x, y, z: Its direction, a unit vector in the world.

    Returns:
        Metres; inf where the ray misses.
    """
    px, py, above = local(rotation[g], sx, sy, sz)
    dx, dy, rising = local(rotation[g], x, y, z)
    if above < 0.0 or rising >= 0.0:
        return math.inf
    t = -above / rising
    for half, p, d in ((size[g, 0], px, dx), (size[g, 1], py, dy)):
        if half > 0.0 and abs(p + t * d) > half:
            return math.inf
    return t


@kernel
def meet_ball(px, py, pz, dx, dy, dz, radius):
    """Find the distance to a ball about 0, as `meet` does.

    Args:
        px, py, pz: Where the ray begins, metres.
        dx, dy, dz: Its direction, a unit vector.
        radius: The ball's, metres.

    Returns:
        Metres; inf where the ray misses.
    """
    enter, leave = _in_ball(px, py, pz, dx, dy, dz, radius)
    return _first(enter, leave)


@kernel
def _first(enter, leave):
    """Return where a ray meets a convex shape in which its line is from `enter` to `leave`."""
    if enter > leave or leave < 0.0:
        return math.inf
    return enter if enter >= 0.0 else leave


@kernel
def _in_box(a, b, c, px, py, pz, dx, dy, dz):
    """Intersect three slabs (Kay and Kajiya 1986)."""
    enter, leave = _in_slab(a, px, dx)
    for half, p, d in ((b, py, dy), (c, pz, dz)):
        near, far = _in_slab(half, p, d)
        enter, leave = max(enter, near), min(leave, far)
    return enter, leave


@kernel
def _in_slab(half, p, d):
    """Return the interval of t in which p + t d lies within [-half, half]; empty if reversed."""
    # a division would give NaN for a line that runs in a face
    if d == 0.0:
        if abs(p) <= half:
            return -math.inf, math.inf
        return math.inf, -math.inf
    lower, upper = (-half - p) / d, (half - p) / d
    return min(lower, upper), max(lower, upper)


@kernel
def _in_ball(px, py, pz, dx, dy, dz, radius):
    """Solve about the point of closest approach, so that far balls lose no digits."""
    b = px * dx + py * dy + pz * dz
    cx, cy, cz = px - b * dx, py - b * dy, pz - b * dz
    h = radius * radius - (cx * cx + cy * cy + cz * cz)
    if h < 0.0:
        return math.inf, -math.inf
    h = math.sqrt(h)
    return -b - h, -b + h


@kernel
def _in_cylinder(radius, half, px, py, pz, dx, dy, dz):
    """Intersect the slab between the flat ends of a cylinder about z with its round side."""
    enter, leave = _in_slab(half, pz, dz)
    a = dx * dx + dy * dy
    if a == 0.0:
        if px * px + py * py <= radius * radius:
            return enter, leave
        return math.inf, -math.inf
    # about the closest approach, as for a ball; a is the squared speed across the axis
    b = -(px * dx + py * dy) / a
    cx, cy = px + b * dx, py + b * dy
    h = (radius * radius - (cx * cx + cy * cy)) / a
    if h < 0.0:
        return math.inf, -math.inf
    h = math.sqrt(h)
    enter, leave = max(enter, b - h), min(leave, b + h)
    if enter <= leave:
        return enter, leave
    return math.inf, -math.inf


@kernel
def axes(x, y, z):
    """Find the axis along which a vector runs farthest.

    Args:
        x, y, z: The vector.

    Returns:
        u, v, w: unsigned numbers of axes, w the farthest, cyclic, so that (u, v, w) is
            right-handed.
    """
    w = np.uint64(1 if abs(y) > abs(x) else 0)
    w = np.uint64(2) if abs(z) > max(abs(x), abs(y)) else w
    return (w + np.uint64(1)) % np.uint64(3), (w + np.uint64(2)) % np.uint64(3), w


@kernel
def upright(origin, ray):
    """Compute the frame of a ray for `meet_triangle`.

    Args:
        origin: (3,), metres.
        ray: (3,): its direction.

    Returns:
        Axes u, v and w, along which it runs fastest; the origin's coordinates along u, v, w; how
        far the ray runs along u and v for a metre along w; and how far along w for a metre of its
        own.
    """
    u, v, w = axes(ray[0], ray[1], ray[2])
    return u, v, w, origin[u], origin[v], origin[w], ray[u] / ray[w], ray[v] / ray[w], ray[w]


@kernel
def meet_triangle(triangles, k, frame):
    """Find the distance to a triangle, seen from either side (Woop, Benthin and Wald 2013).

    Corners, relative to the origin, are slid along u and v so that the ray becomes the axis w.
    Triangles that share a corner slide it to the same bits, and those that share an edge find the
    axis on opposite sides of it, or both on it: nothing passes between them.

    Args:
        triangles: (T, 3, 3), metres.
        k: The triangle's number.
        frame: Of the ray, by `upright`.

    Returns:
        Metres; inf where the ray misses.
    """
    u, v, w, ou, ov, ow, su, sv, dw = frame
    wa, wb, wc = triangles[k, 0, w] - ow, triangles[k, 1, w] - ow, triangles[k, 2, w] - ow
    ua, va = triangles[k, 0, u] - ou - su * wa, triangles[k, 0, v] - ov - sv * wa
    ub, vb = triangles[k, 1, u] - ou - su * wb, triangles[k, 1, v] - ov - sv * wb
    uc, vc = triangles[k, 2, u] - ou - su * wc, triangles[k, 2, v] - ov - sv * wc
    a, b, c = (
        uc * vb - vc * ub,
        ua * vc - va * uc,
        ub * va - vb * ua,
    )  # areas, and weights of the corners
    # signs differ outside; zeros count as inside, so that an edge belongs to both triangles
    if min(a, b, c) < 0.0 < max(a, b, c):
        return math.inf
    total = a + b + c
    if total == 0.0:  # seen edge-on; its neighbours are met instead
        return math.inf
    t = (a * wa + b * wb + c * wc) / (total * dw)
    return t if t >= 0.0 else math.inf


def squared_reaches(shape: Ints, size: Floats) -> Floats:
    """Compute bounding balls about the centres of primitives.

    Args:
        shape: (n,): codes.
        size: (n, 3), metres.

    Returns:
        (n,): squared radii, m², of radii a millionth larger than needed; inf for planes.
    """
    radius, half = size[:, 0], size[:, 1]
    radius = np.select(
        [shape == PLANE, shape == SPHERE, shape == CAPSULE, shape == CYLINDER, shape == ELLIPSOID],
        [np.inf, radius, radius + half, np.sqrt(radius**2 + half**2), size.max(axis=1)],
        np.sqrt((size**2).sum(axis=1)),
    )
    # rounding of distances elsewhere must not leave out a solid that is touched
    return (radius * (1.0 + 1e-6)) ** 2


@kernel
def surface_normal(shape, a, b, c, px, py, pz):
    """Compute the outward unit normal at a point on a shape's surface, in its frame.

    Args:
        shape: Its code.
        a, b, c: MuJoCo's sizes, metres.
        px, py, pz: The point, metres.

    Returns:
        x, y, z of the normal.
    """
    x, y, z = 0.0, 0.0, 1.0  # a plane's
    if shape == BOX:
        # how far outside each pair of faces: the greatest is 0
        u, v, w = abs(px) - a, abs(py) - b, abs(pz) - c
        if u >= v and u >= w:
            x, y, z = px, 0.0, 0.0
        elif v >= w:
            x, y, z = 0.0, py, 0.0
        else:
            x, y, z = 0.0, 0.0, pz
    elif shape == SPHERE:
        x, y, z = px, py, pz
    elif shape == ELLIPSOID:
        # the gradient of x²/a² + y²/b² + z²/c²
        x, y, z = px / (a * a), py / (b * b), pz / (c * c)
    elif shape == CAPSULE:
        # away from the nearest point of the capsule's segment
        x, y, z = px, py, pz - max(min(pz, b), -b)
    elif shape == CYLINDER:
        # the surface that the point is farther out of: side or end
        if abs(pz) - b < math.sqrt(px * px + py * py) - a:
            x, y, z = px, py, 0.0
        else:
            x, y, z = 0.0, 0.0, pz
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length
