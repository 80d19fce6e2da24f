"""Where a ray meets a shape, in closed form, and the normal there. Every shape stands in its own
frame, as MuJoCo's.

A ray that starts inside a solid meets its surface where it comes out, as MuJoCo's does.
"""

import math

import numpy as np

from lidarsim.grid import Floats, Ints
from lidarsim.jit import kernel
from lidarsim.solids import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE, local


@kernel
def meet(shape, a, b, c, px, py, pz, dx, dy, dz):
    """Distance from p along the unit vector d to the shape's surface, in its own frame; inf where
    it is not met. From inside, that is where the ray comes out.

    Shapes are convex: a line is in each from one distance to another. Those of a shape of several
    parts follow from its parts', so that rounding opens no seam between them. Planes: `meet_plane`.
    """
    if shape == BOX:
        enter, leave = _in_box(a, b, c, px, py, pz, dx, dy, dz)
        return _first(enter, leave)
    if shape == SPHERE:
        return meet_ball(px, py, pz, dx, dy, dz, a)
    if shape == ELLIPSOID:  # a unit ball, stretched; the direction then has another length
        u, v, w = dx / a, dy / b, dz / c
        length = math.sqrt(u * u + v * v + w * w)
        t = meet_ball(px / a, py / b, pz / c, u / length, v / length, w / length, 1.0)
        return t / length
    enter, leave = _in_cylinder(a, b, px, py, pz, dx, dy, dz)
    if shape == CAPSULE:
        for end in (-b, b):
            one, other = _in_ball(px, py, pz - end, dx, dy, dz, a)
            enter, leave = min(enter, one), max(leave, other)
    return _first(enter, leave)


@kernel
def meet_plane(g, size, rotation, sx, sy, sz, x, y, z):
    """Distance from s, seen from its centre, along the unit vector (x, y, z) to the plane g, seen
    from above and within its half sizes, where these are not 0."""
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
    """`meet` for a ball."""
    enter, leave = _in_ball(px, py, pz, dx, dy, dz, radius)
    return _first(enter, leave)


@kernel
def _first(enter, leave):
    """Where a ray meets what its line is in from `enter` to `leave`."""
    if enter > leave or leave < 0.0:
        return math.inf
    return enter if enter >= 0.0 else leave


@kernel
def _in_box(a, b, c, px, py, pz, dx, dy, dz):
    """Slabs (Kay and Kajiya 1986)."""
    enter, leave = _in_slab(a, px, dx)
    for half, p, d in ((b, py, dy), (c, pz, dz)):
        one, other = _in_slab(half, p, d)
        enter, leave = max(enter, one), min(leave, other)
    return enter, leave


@kernel
def _in_slab(half, p, d):
    """Where a line along which a coordinate is p + t d has it in [-half, half]."""
    if d == 0.0:
        if abs(p) <= half:
            return -math.inf, math.inf
        return math.inf, -math.inf
    one, other = (-half - p) / d, (half - p) / d
    return min(one, other), max(one, other)


@kernel
def _in_ball(px, py, pz, dx, dy, dz, radius):
    """Roots about the point of closest approach, so that far balls lose no digits."""
    b = px * dx + py * dy + pz * dz
    cx, cy, cz = px - b * dx, py - b * dy, pz - b * dz
    h = radius * radius - (cx * cx + cy * cy + cz * cz)
    if h < 0.0:
        return math.inf, -math.inf
    h = math.sqrt(h)
    return -b - h, -b + h


@kernel
def _in_cylinder(radius, half, px, py, pz, dx, dy, dz):
    """The slab between the flat ends of a cylinder about z, and its round side."""
    enter, leave = _in_slab(half, pz, dz)
    a = dx * dx + dy * dy
    if a == 0.0:
        if px * px + py * py <= radius * radius:
            return enter, leave
        return math.inf, -math.inf
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
    """The axis w along which a vector runs farthest, behind u and v, the other two."""
    w = np.uint64(1 if abs(y) > abs(x) else 0)
    w = np.uint64(2) if abs(z) > max(abs(x), abs(y)) else w
    return (w + np.uint64(1)) % np.uint64(3), (w + np.uint64(2)) % np.uint64(3), w


@kernel
def upright(origin, ray):
    """What `meet_triangle` takes for a ray (3,) from `origin` (3,): w, the axis along which it runs
    fastest, behind u and v, the other two; the origin's coordinates along u, v, w; how far the ray
    runs along u and v for a metre along w; how far along w for a metre of its own."""
    u, v, w = axes(ray[0], ray[1], ray[2])
    return u, v, w, origin[u], origin[v], origin[w], ray[u] / ray[w], ray[v] / ray[w], ray[w]


@kernel
def meet_triangle(triangles, k, frame):
    """Distance to triangle k of (T, 3, 3), seen from either side (Woop, Benthin and Wald 2013), in
    the `frame` of the ray that `upright` gives.

    Corners, relative to the origin, are slid along u and v so that the ray becomes the axis w.
    Triangles that share a corner slide it to the same bits, and those that share an edge find the
    axis on opposite sides of it, or both on it: nothing passes between them.
    """
    u, v, w, ou, ov, ow, su, sv, dw = frame
    wa, wb, wc = triangles[k, 0, w] - ow, triangles[k, 1, w] - ow, triangles[k, 2, w] - ow
    ua, va = triangles[k, 0, u] - ou - su * wa, triangles[k, 0, v] - ov - sv * wa
    ub, vb = triangles[k, 1, u] - ou - su * wb, triangles[k, 1, v] - ov - sv * wb
    uc, vc = triangles[k, 2, u] - ou - su * wc, triangles[k, 2, v] - ov - sv * wc
    a, b, c = uc * vb - vc * ub, ua * vc - va * uc, ub * va - vb * ua  # weights of the corners
    if min(a, b, c) < 0.0 < max(a, b, c):
        return math.inf
    total = a + b + c
    if total == 0.0:  # seen edge-on, and met where the triangles beside it are
        return math.inf
    t = (a * wa + b * wb + c * wc) / (total * dw)
    return t if t >= 0.0 else math.inf


def squared_reaches(shape: Ints, size: Floats) -> Floats:
    """Squared radii (n,) of balls about the centres of primitives that hold them, radii a millionth
    larger than need be; inf for planes."""
    radius, half = size[:, 0], size[:, 1]
    radius = np.select(
        [shape == PLANE, shape == SPHERE, shape == CAPSULE, shape == CYLINDER, shape == ELLIPSOID],
        [np.inf, radius, radius + half, np.sqrt(radius**2 + half**2), size.max(axis=1)],
        np.sqrt((size**2).sum(axis=1)),
    )
    return (radius * (1.0 + 1e-6)) ** 2


@kernel
def normal(shape, a, b, c, px, py, pz):
    """Outward unit normal (x, y, z) of the shape at p, a point on its surface, in its own frame."""
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
        x, y, z = px / (a * a), py / (b * b), pz / (c * c)
    elif shape == CAPSULE:
        x, y, z = px, py, pz - max(min(pz, b), -b)
    elif shape == CYLINDER:
        if abs(pz) - b < math.sqrt(px * px + py * py) - a:
            x, y, z = px, py, 0.0
        else:
            x, y, z = 0.0, 0.0, pz
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length
