"""Rays through many worlds at once: one thread a ray, `lidarsim.engines.forms` and `traverse` again
in Warp."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.engines import traverse
from lidarsim.gpu.device import EXACT, on_device, placed, wp
from lidarsim.gpu.worlds import Packed, Worlds
from lidarsim.solids.shapes import BOX, CAPSULE, ELLIPSOID, PLANE, SPHERE

wp.set_module_options(EXACT)
INF = wp.constant(wp.float64(np.inf))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
TINY = wp.constant(wp.float64(1e-300))
HUGE = wp.constant(wp.float64(1e300))
SPARE = wp.constant(wp.float64(traverse.SPARE_LENGTH2))
ROUNDED = wp.constant(wp.float64(traverse.ROUNDED))
FARTHER = wp.constant(wp.float64(traverse.FARTHER))


def cast(
    worlds: Worlds,
    origins: Any,
    directions: Any,
    max_range_m: float,
    *,
    which: ArrayLike | None = None,
) -> Any:
    """Metres along the rays to the first surface, a Warp array (P, R) of float64 on the worlds'
    device; ``inf`` where nothing is met within `max_range_m`.

    Pose p stands at `origins` (P, 3) in world `which` (P,), which is world p unless said otherwise,
    and looks along the unit vectors `directions` (P, R, 3): NumPy's arrays, or Warp's of ``vec3d``,
    (P,) and (P, R). A ray that is no unit vector, or whose origin is not finite, meets nothing.
    Raises ValueError for arrays of other shapes.
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
    o, d = origins[p], wp.vec3d(directions[p, n])
    best = wp.float64(max_range_m)
    met = wp.bool(False)
    box = wp.int32(packed.box_start[which[p]])
    end = wp.int32(packed.box_start[which[p] + 1])
    length2 = wp.dot(d, d)
    if not (wp.abs(length2 - ONE) <= SPARE and wp.abs(o[0]) + wp.abs(o[1]) + wp.abs(o[2]) < INF):
        box = end
    if wp.abs(length2 - ONE) > ROUNDED:
        d /= wp.sqrt(length2)
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
        return _meet_triangle(
            packed.triangles[k, 0], packed.triangles[k, 1], packed.triangles[k, 2], o, d
        )
    shape = packed.shape[item]
    s = o - packed.position[item]
    along, apart2 = wp.dot(s, d), wp.dot(s, s)
    reach2 = packed.reach2[item]
    if apart2 * FARTHER - along * along > reach2 or (along > ZERO and apart2 > reach2):
        return INF  # passes the ball around the solid, or leaves it behind
    if shape == SPHERE:
        return _meet_ball(s, d, packed.size[item][0])
    inwards = wp.transpose(packed.rotation[item])
    return _meet(shape, packed.size[item], inwards * s, inwards * d)


@wp.func
def _meet(shape: wp.int32, size: wp.vec3d, p: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Distance from p along the unit vector d to the shape's surface, in its own frame."""
    if shape == PLANE:
        if p[2] < ZERO or d[2] >= ZERO:
            return INF
        t = -p[2] / d[2]
        if size[0] > ZERO and wp.abs(p[0] + t * d[0]) > size[0]:
            return INF
        return INF if size[1] > ZERO and wp.abs(p[1] + t * d[1]) > size[1] else t
    if shape == BOX:
        return _first(_in_box(size, p, d))
    if shape == ELLIPSOID:  # a unit ball, stretched; the direction then has another length
        v = wp.cw_div(d, size)
        length = wp.length(v)
        return _meet_ball(wp.cw_div(p, size), v / length, ONE) / length
    part = _in_cylinder(size[0], size[1], p, d)
    if shape == CAPSULE:
        for end in range(2):
            z = size[1] if end == 1 else -size[1]
            ball = _in_ball(wp.vec3d(p[0], p[1], p[2] - z), d, size[0])
            part = wp.vec2d(wp.min(part[0], ball[0]), wp.max(part[1], ball[1]))
    return _first(part)


@wp.func
def _meet_ball(p: wp.vec3d, d: wp.vec3d, radius: wp.float64) -> wp.float64:
    """`_meet` for a ball."""
    return _first(_in_ball(p, d, radius))


@wp.func
def _first(part: wp.vec2d) -> wp.float64:
    """Where a ray meets what its line is in from one distance to another."""
    if part[0] > part[1] or part[1] < ZERO:
        return INF
    return part[0] if part[0] >= ZERO else part[1]


@wp.func
def _in_box(half: wp.vec3d, p: wp.vec3d, d: wp.vec3d) -> wp.vec2d:
    """Slabs (Kay and Kajiya 1986)."""
    part = _in_slab(half[0], p[0], d[0])
    for axis in range(1, 3):
        slab = _in_slab(half[axis], p[axis], d[axis])
        part = wp.vec2d(wp.max(part[0], slab[0]), wp.min(part[1], slab[1]))
    return part


@wp.func
def _in_slab(half: wp.float64, p: wp.float64, d: wp.float64) -> wp.vec2d:
    """Where a line along which a coordinate is p + t d has it in [-half, half]."""
    if d == ZERO:
        return wp.vec2d(-INF, INF) if wp.abs(p) <= half else wp.vec2d(INF, -INF)
    one, other = (-half - p) / d, (half - p) / d
    return wp.vec2d(wp.min(one, other), wp.max(one, other))


@wp.func
def _in_ball(p: wp.vec3d, d: wp.vec3d, radius: wp.float64) -> wp.vec2d:
    """Roots about the point of closest approach, so that far balls lose no digits."""
    b = wp.dot(p, d)
    c = p - b * d
    h = radius * radius - wp.dot(c, c)
    if h < ZERO:
        return wp.vec2d(INF, -INF)
    h = wp.sqrt(h)
    return wp.vec2d(-b - h, -b + h)


@wp.func
def _in_cylinder(radius: wp.float64, half: wp.float64, p: wp.vec3d, d: wp.vec3d) -> wp.vec2d:
    """The slab between the flat ends of a cylinder about z, and its round side."""
    slab = _in_slab(half, p[2], d[2])
    a = d[0] * d[0] + d[1] * d[1]
    if a == ZERO:
        return slab if p[0] * p[0] + p[1] * p[1] <= radius * radius else wp.vec2d(INF, -INF)
    b = -(p[0] * d[0] + p[1] * d[1]) / a
    cx, cy = p[0] + b * d[0], p[1] + b * d[1]
    h = (radius * radius - (cx * cx + cy * cy)) / a
    if h < ZERO:
        return wp.vec2d(INF, -INF)
    h = wp.sqrt(h)
    part = wp.vec2d(wp.max(slab[0], b - h), wp.min(slab[1], b + h))
    return part if part[0] <= part[1] else wp.vec2d(INF, -INF)


@wp.func
def _meet_triangle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, o: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Distance to the triangle abc, seen from either side: see `forms.meet_triangle`."""
    w = wp.int32(0)
    if wp.abs(d[1]) > wp.abs(d[0]):
        w = wp.int32(1)
    if wp.abs(d[2]) > wp.abs(d[w]):
        w = wp.int32(2)
    u, v = (w + 1) % 3, (w + 2) % 3
    su, sv = d[u] / d[w], d[v] / d[w]
    wa, wb, wc = a[w] - o[w], b[w] - o[w], c[w] - o[w]
    ua, va = a[u] - o[u] - su * wa, a[v] - o[v] - sv * wa
    ub, vb = b[u] - o[u] - su * wb, b[v] - o[v] - sv * wb
    uc, vc = c[u] - o[u] - su * wc, c[v] - o[v] - sv * wc
    p, q, r = uc * vb - vc * ub, ua * vc - va * uc, ub * va - vb * ua
    if wp.min(p, wp.min(q, r)) < ZERO and wp.max(p, wp.max(q, r)) > ZERO:
        return INF
    total = p + q + r
    if total == ZERO:
        return INF
    t = (p * wa + q * wb + r * wc) / (total * d[w])
    return t if t >= ZERO else INF
