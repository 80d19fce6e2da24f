"""Rays through many worlds at once: one thread a ray, `lidarsim.engines.forms` and `traverse` again in Warp."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.engines.traverse import SPARE_LENGTH2
from lidarsim.gpu.device import EXACT, on_device, placed, wp
from lidarsim.gpu.worlds import Packed, Worlds
from lidarsim.solids.shapes import BOX, CAPSULE, ELLIPSOID, PLANE, SPHERE

wp.set_module_options(EXACT)
INF = wp.constant(wp.float64(np.inf))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
TINY = wp.constant(wp.float64(1e-300))
HUGE = wp.constant(wp.float64(1e300))
SPARE = wp.constant(wp.float64(SPARE_LENGTH2))


def cast(worlds: Worlds, origins: Any, directions: Any, max_range_m: float, *, which: ArrayLike | None = None) -> Any:
    """Metres along the rays to the first surface, a Warp array (P, R) of float64 on the worlds' device; ``inf`` where
    nothing is met within `max_range_m`.

    Pose p stands at `origins` (P, 3) in world `which` (P,), which is world p unless said otherwise, and looks along
    the unit vectors `directions` (P, R, 3): NumPy's arrays, or Warp's of ``vec3d``, (P,) and (P, R). A ray that is no
    unit vector, or whose origin is not finite, meets nothing. Raises ValueError for arrays of other shapes.
    """
    starts, rays = (on_device(values, wp.vec3d, worlds.device) for values in (origins, directions))
    poses, count = rays.shape if rays.ndim == 2 else (len(rays), 0)
    placed("origins", starts, (poses,), wp.vec3d, worlds.device)
    placed("directions", rays, (poses, count), wp.vec3d, worlds.device)
    ranges = wp.empty((poses, count), dtype=wp.float64, device=worlds.device)
    inputs = [worlds.packed, worlds.which(which, poses), starts, rays, float(max_range_m), ranges]
    wp.launch(_cast, dim=ranges.shape, inputs=inputs, device=worlds.device)
    return ranges


@wp.kernel
def _cast(
    packed: Packed,
    which: wp.array[wp.int32],
    origins: wp.array[wp.vec3d],
    directions: wp.array2d[wp.vec3d],
    max_range_m: wp.float64,
    ranges: wp.array2d[wp.float64],
) -> None:
    p, n = wp.tid()
    o, d = origins[p], directions[p, n]
    best = wp.float64(max_range_m)
    met = wp.bool(False)
    box = wp.int32(packed.box_start[which[p]])
    end = wp.int32(packed.box_start[which[p] + 1])
    if not (wp.abs(wp.dot(d, d) - ONE) <= SPARE and wp.abs(o[0]) + wp.abs(o[1]) + wp.abs(o[2]) < INF):
        box = end
    inverse = wp.vec3d(_inverse(d[0]), _inverse(d[1]), _inverse(d[2]))
    while box < end:
        one = wp.cw_mul(packed.box_lower[box] - o, inverse)
        other = wp.cw_mul(packed.box_upper[box] - o, inverse)
        near, far = wp.min(one, other), wp.max(one, other)
        begin = wp.max(wp.max(near[0], near[1]), wp.max(near[2], ZERO))
        if begin > wp.min(wp.min(far[0], far[1]), wp.min(far[2], best)):
            box = packed.beyond[box]
            continue
        for q in range(packed.first[box], packed.last[box]):
            t = _meet_item(packed, packed.item[q], o, d)
            if t <= best and t < INF:
                best = t
                met = True
        box += 1
    ranges[p, n] = best if met else INF


@wp.func
def _inverse(d: wp.float64) -> wp.float64:
    """1 / d, or what is as good and finite where the ray runs along the slab."""
    if wp.abs(d) > TINY:
        return ONE / d
    return HUGE


@wp.func
def _meet_item(packed: Packed, item: wp.int32, o: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Distance to a primitive or a triangle of the world."""
    if item < 0:
        k = -1 - item
        return _meet_triangle(packed.triangles[k, 0], packed.triangles[k, 1], packed.triangles[k, 2], o, d)
    shape = packed.shape[item]
    s = o - packed.position[item]
    if shape != PLANE:
        along, apart2 = wp.dot(s, d), wp.dot(s, s)
        reach2 = packed.reach2[item]
        if apart2 - along * along > reach2 or (along > ZERO and apart2 > reach2):
            return INF  # passes the ball around the solid, or leaves it behind
        if shape == SPHERE:
            return _meet_ball(s, d, packed.size[item][0])
    inwards = wp.transpose(packed.rotation[item])
    return _meet(shape, packed.size[item], inwards * s, inwards * d)


@wp.func
def _meet(shape: wp.int32, size: wp.vec3d, p: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Distance from p along the unit vector d to the shape's surface, in its own frame."""
    if shape == PLANE:
        return -p[2] / d[2] if p[2] > ZERO and d[2] < ZERO else INF
    if shape == BOX:
        return _meet_box(size, p, d)
    if shape == ELLIPSOID:  # a unit ball, stretched; the direction then has another length
        v = wp.cw_div(d, size)
        length = wp.length(v)
        return _meet_ball(wp.cw_div(p, size), v / length, ONE) / length
    radius, half = size[0], size[1]
    best = _meet_side(radius, half, p, d)
    if shape == CAPSULE:
        return wp.min(best, wp.min(_meet_end(radius, -half, p, d), _meet_end(radius, half, p, d)))
    if d[2] != ZERO:
        return wp.min(best, wp.min(_meet_disc(radius, -half, p, d), _meet_disc(radius, half, p, d)))
    return best


@wp.func
def _meet_box(half: wp.vec3d, p: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Slabs (Kay and Kajiya 1986)."""
    enter, leave = -INF, INF
    for axis in range(3):
        if d[axis] == ZERO:
            if wp.abs(p[axis]) > half[axis]:
                return INF
        else:
            one, other = (-half[axis] - p[axis]) / d[axis], (half[axis] - p[axis]) / d[axis]
            enter = wp.max(enter, wp.min(one, other))
            leave = wp.min(leave, wp.max(one, other))
    if enter > leave or leave < ZERO:
        return INF
    return enter if enter >= ZERO else leave


@wp.func
def _meet_ball(p: wp.vec3d, d: wp.vec3d, radius: wp.float64) -> wp.float64:
    """Roots about the point of closest approach, so that far balls lose no digits."""
    b = wp.dot(p, d)
    c = p - b * d
    h = radius * radius - wp.dot(c, c)
    if h < ZERO:
        return INF
    h = wp.sqrt(h)
    if -b - h >= ZERO:
        return -b - h
    return -b + h if -b + h >= ZERO else INF


@wp.func
def _meet_side(radius: wp.float64, half: wp.float64, p: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """The round side of a cylinder about z, of half length `half`."""
    a = d[0] * d[0] + d[1] * d[1]
    if a == ZERO:
        return INF
    b = -(p[0] * d[0] + p[1] * d[1]) / a
    cx, cy = p[0] + b * d[0], p[1] + b * d[1]
    h = (radius * radius - (cx * cx + cy * cy)) / a
    if h < ZERO:
        return INF
    h = wp.sqrt(h)
    if b - h >= ZERO and wp.abs(p[2] + (b - h) * d[2]) <= half:
        return b - h
    return b + h if b + h >= ZERO and wp.abs(p[2] + (b + h) * d[2]) <= half else INF


@wp.func
def _meet_disc(radius: wp.float64, end: wp.float64, p: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """The flat end of a cylinder at z = `end`, for a ray that does not run along it."""
    t = (end - p[2]) / d[2]
    x, y = p[0] + t * d[0], p[1] + t * d[1]
    return t if t >= ZERO and x * x + y * y <= radius * radius else INF


@wp.func
def _meet_end(radius: wp.float64, end: wp.float64, p: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """The round end of a capsule at z = `end`: the half of its ball that lies beyond."""
    q = wp.vec3d(p[0], p[1], p[2] - end)
    b = wp.dot(q, d)
    c = q - b * d
    h = radius * radius - wp.dot(c, c)
    if h < ZERO:
        return INF
    h = wp.sqrt(h)
    outwards = ONE if end >= ZERO else -ONE
    if -b - h >= ZERO and outwards * (q[2] + (-b - h) * d[2]) >= ZERO:
        return -b - h
    return -b + h if -b + h >= ZERO and outwards * (q[2] + (-b + h) * d[2]) >= ZERO else INF


@wp.func
def _meet_triangle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, o: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Distance to the triangle abc, seen from either side (Moller and Trumbore 1997)."""
    u, v, s = b - a, c - a, o - a
    h = wp.cross(d, v)
    det = wp.dot(u, h)
    if det == ZERO:
        return INF
    share = ONE / det
    p = share * wp.dot(s, h)
    if p < ZERO or p > ONE:
        return INF
    q = wp.cross(s, u)
    r = share * wp.dot(d, q)
    if r < ZERO or p + r > ONE:
        return INF
    t = share * wp.dot(v, q)
    return t if t >= ZERO else INF
