"""Where a ray meets a shape, in closed form, and the normal there. Every shape stands in its own frame, as MuJoCo's.

A ray that starts inside a solid meets its surface where it comes out, as MuJoCo's does.
"""

import math

from lidarsim.jit import kernel
from lidarsim.solids.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE


@kernel
def meet(shape, a, b, c, px, py, pz, dx, dy, dz):
    """Distance from p along the unit vector d to the shape's surface, in its own frame; inf where it is not met.
    From inside, that is where the ray comes out."""
    if shape == PLANE:
        return -pz / dz if pz > 0.0 and dz < 0.0 else math.inf
    if shape == BOX:
        return _meet_box(a, b, c, px, py, pz, dx, dy, dz)
    if shape == SPHERE:
        return meet_ball(px, py, pz, dx, dy, dz, a)
    if shape == ELLIPSOID:  # a unit ball, stretched; the direction then has another length
        u, v, w = dx / a, dy / b, dz / c
        length = math.sqrt(u * u + v * v + w * w)
        t = meet_ball(px / a, py / b, pz / c, u / length, v / length, w / length, 1.0)
        return t / length
    radius, half = a, b
    best = _meet_side(radius, half, px, py, pz, dx, dy, dz)
    for end in (-half, half):
        if shape == CAPSULE:
            best = min(best, _meet_end(radius, end, px, py, pz, dx, dy, dz))
        elif shape == CYLINDER and dz != 0.0:
            t = (end - pz) / dz
            x, y = px + t * dx, py + t * dy
            if t >= 0.0 and x * x + y * y <= radius * radius:
                best = min(best, t)
    return best


@kernel
def _meet_box(a, b, c, px, py, pz, dx, dy, dz):
    """Slabs (Kay and Kajiya 1986)."""
    enter, leave = -math.inf, math.inf
    for axis in range(3):
        p = px if axis == 0 else (py if axis == 1 else pz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        half = a if axis == 0 else (b if axis == 1 else c)
        if d == 0.0:
            if abs(p) > half:
                return math.inf
            continue
        one, other = (-half - p) / d, (half - p) / d
        enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
    if enter > leave or leave < 0.0:
        return math.inf
    return enter if enter >= 0.0 else leave


@kernel
def meet_ball(px, py, pz, dx, dy, dz, radius):
    """Roots about the point of closest approach, so that far balls lose no digits."""
    b = px * dx + py * dy + pz * dz
    cx, cy, cz = px - b * dx, py - b * dy, pz - b * dz
    h = radius * radius - (cx * cx + cy * cy + cz * cz)
    if h < 0.0:
        return math.inf
    h = math.sqrt(h)
    if -b - h >= 0.0:
        return -b - h
    return -b + h if -b + h >= 0.0 else math.inf


@kernel
def _meet_side(radius, half, px, py, pz, dx, dy, dz):
    """The round side of a cylinder about z, of half length `half`."""
    a = dx * dx + dy * dy
    if a == 0.0:
        return math.inf
    b = -(px * dx + py * dy) / a
    cx, cy = px + b * dx, py + b * dy
    h = (radius * radius - (cx * cx + cy * cy)) / a
    if h < 0.0:
        return math.inf
    h = math.sqrt(h)
    for t in (b - h, b + h):
        if t >= 0.0 and abs(pz + t * dz) <= half:
            return t
    return math.inf


@kernel
def _meet_end(radius, end, px, py, pz, dx, dy, dz):
    """The round end of a capsule at z = `end`: the half of its ball that lies beyond."""
    q = pz - end
    b = px * dx + py * dy + q * dz
    cx, cy, cz = px - b * dx, py - b * dy, q - b * dz
    h = radius * radius - (cx * cx + cy * cy + cz * cz)
    if h < 0.0:
        return math.inf
    h = math.sqrt(h)
    for t in (-b - h, -b + h):
        z = q + t * dz
        if t >= 0.0 and (z >= 0.0 if end >= 0.0 else z <= 0.0):
            return t
    return math.inf


@kernel
def meet_triangle(triangles, k, ox, oy, oz, dx, dy, dz):
    """Distance to triangle k of (T, 3, 3), seen from either side (Moller and Trumbore 1997)."""
    x, y, z = triangles[k, 0, 0], triangles[k, 0, 1], triangles[k, 0, 2]
    ux, uy, uz = triangles[k, 1, 0] - x, triangles[k, 1, 1] - y, triangles[k, 1, 2] - z
    vx, vy, vz = triangles[k, 2, 0] - x, triangles[k, 2, 1] - y, triangles[k, 2, 2] - z
    hx, hy, hz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    det = ux * hx + uy * hy + uz * hz
    if det == 0.0:
        return math.inf
    share = 1.0 / det
    sx, sy, sz = ox - x, oy - y, oz - z
    u = share * (sx * hx + sy * hy + sz * hz)
    if u < 0.0 or u > 1.0:
        return math.inf
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = share * (dx * qx + dy * qy + dz * qz)
    if v < 0.0 or u + v > 1.0:
        return math.inf
    t = share * (vx * qx + vy * qy + vz * qz)
    return t if t >= 0.0 else math.inf


@kernel
def ball_around(shape, size):
    """Radius of a ball about the shape's centre that holds it, a millionth larger than need be; inf around a plane."""
    a, b, c = size[0], size[1], size[2]
    if shape == PLANE:
        return math.inf
    if shape == SPHERE:
        radius = a
    elif shape == CAPSULE:
        radius = a + b
    elif shape == CYLINDER:
        radius = math.sqrt(a * a + b * b)
    elif shape == ELLIPSOID:
        radius = max(a, b, c)
    else:
        radius = math.sqrt(a * a + b * b + c * c)
    return radius * (1.0 + 1e-6)


@kernel
def normal(shape, a, b, c, px, py, pz):
    """Outward unit normal (x, y, z) of the shape at p, a point on its surface, in its own frame."""
    x, y, z = 0.0, 0.0, 1.0  # a plane's
    if shape == BOX:
        u, v, w = abs(px) - a, abs(py) - b, abs(pz) - c  # how far outside each pair of faces: the greatest is 0
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
