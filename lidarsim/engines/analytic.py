"""Rays by closed forms, one kernel over all poses, with nothing of MuJoCo's ray caster in it."""

import math
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.jit import kernel
from lidarsim.solids.shapes import BOX, CAPSULE, CYLINDER, ELLIPSOID, PLANE, SPHERE, Solids

if TYPE_CHECKING:
    import mujoco

SPARE_M = 1.0
"""How much farther than the range a solid's box may be before the solid is passed over."""


class AnalyticEngine:
    """Casts rays at primitives by closed forms, and at the triangles of meshes and height fields: an `Engine`."""

    def __init__(self, solids: Solids):
        self._solids = solids

    @classmethod
    def of(cls, model: "mujoco.MjModel", data: "mujoco.MjData | None" = None) -> Self:
        """See `lidarsim.engines.Engine.of`. Raises ValueError as `solids_of` does."""
        from lidarsim.solids.model import solids_of  # loads MuJoCo, which an engine over known solids does not need

        return cls(solids_of(model, data))

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> NDArray[np.float64]:
        """See `lidarsim.engines.Engine.cast`."""
        # copies, for the kernel is compiled for arrays that can be written
        starts = np.array(origins, dtype=np.float64, order="C")
        vectors = np.array(directions, dtype=np.float64, order="C")
        solids, poses = self._solids, len(starts)
        ranges = np.full(vectors.shape[:-1], np.inf)
        if ranges.size:
            _cast(
                starts,
                vectors.reshape(poses, -1, 3),
                float(max_range_m),
                solids.shape,
                solids.size,
                solids.position,
                solids.rotation,
                solids.lower,
                solids.upper,
                solids.triangles,
                ranges.reshape(poses, -1),
            )
        return ranges


@kernel
def _cast(origins, directions, max_range_m, shape, size, position, rotation, lower, upper, triangles, ranges):
    """Ranges (P, n) of all poses."""
    for p in range(len(origins)):
        near = np.empty(len(shape), np.bool_)
        for g in range(len(shape)):
            near[g] = _apart2(origins[p], lower[g], upper[g]) <= (max_range_m + SPARE_M) ** 2
        _cast_primitives(origins[p], directions[p], shape, size, position, rotation, near, ranges[p])
        _cast_triangles(origins[p], directions[p], triangles, (max_range_m + SPARE_M) ** 2, ranges[p])
        for n in range(ranges.shape[1]):
            if not ranges[p, n] <= max_range_m:
                ranges[p, n] = np.inf


@kernel
def _apart2(origin, lower, upper):
    """Squared distance from the origin to a box."""
    total = 0.0
    for a in range(3):
        gap = max(max(lower[a] - origin[a], origin[a] - upper[a]), 0.0)
        total += gap * gap
    return total


@kernel
def _cast_primitives(origin, directions, shape, size, position, rotation, near, distances):
    """Lower `distances` (n,) to the nearest of the primitives that are `near` along each ray."""
    for g in range(len(shape)):
        if not near[g]:
            continue
        ox, oy, oz = origin[0] - position[g, 0], origin[1] - position[g, 1], origin[2] - position[g, 2]
        turn = rotation[g]
        reach = _radius(shape[g], size[g])
        apart = ox * ox + oy * oy + oz * oz
        px = turn[0, 0] * ox + turn[1, 0] * oy + turn[2, 0] * oz
        py = turn[0, 1] * ox + turn[1, 1] * oy + turn[2, 1] * oz
        pz = turn[0, 2] * ox + turn[1, 2] * oy + turn[2, 2] * oz
        for n in range(len(directions)):
            x, y, z = directions[n, 0], directions[n, 1], directions[n, 2]
            towards = -(x * ox + y * oy + z * oz)
            if apart - towards * towards > reach or (towards < 0.0 and apart > reach):
                continue  # passes the ball around the solid, or leaves it behind
            dx = turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z
            dy = turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z
            dz = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z
            t = _meet(shape[g], size[g], px, py, pz, dx, dy, dz)
            if t < distances[n]:
                distances[n] = t


@kernel
def _radius(shape, size):
    """Squared radius of a ball around the shape, a millionth larger than need be."""
    if shape == SPHERE:
        radius = size[0]
    elif shape == CAPSULE:
        radius = size[0] + size[1]
    elif shape == CYLINDER:
        radius = math.sqrt(size[0] * size[0] + size[1] * size[1])
    elif shape == PLANE:
        return math.inf
    elif shape == ELLIPSOID:
        radius = max(size[0], size[1], size[2])
    else:
        radius = math.sqrt(size[0] * size[0] + size[1] * size[1] + size[2] * size[2])
    return (radius * (1.0 + 1e-6)) ** 2


@kernel
def _meet(shape, size, px, py, pz, dx, dy, dz):
    """Distance from p along the unit vector d to the shape's surface, in its own frame; inf where it is not met.
    From inside, that is where the ray comes out."""
    if shape == PLANE:
        return -pz / dz if pz > 0.0 and dz < 0.0 else math.inf
    if shape == BOX:
        return _meet_box(size, px, py, pz, dx, dy, dz)
    if shape == SPHERE:
        return _meet_ball(px, py, pz, dx, dy, dz, size[0])
    if shape == ELLIPSOID:  # a unit ball, stretched; the direction then has another length
        a, b, c = dx / size[0], dy / size[1], dz / size[2]
        length = math.sqrt(a * a + b * b + c * c)
        t = _meet_ball(px / size[0], py / size[1], pz / size[2], a / length, b / length, c / length, 1.0)
        return t / length
    radius, half = size[0], size[1]
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
def _meet_box(size, px, py, pz, dx, dy, dz):
    """Slabs (Kay and Kajiya 1986)."""
    enter, leave = -math.inf, math.inf
    for axis in range(3):
        p = px if axis == 0 else (py if axis == 1 else pz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        if d == 0.0:
            if abs(p) > size[axis]:
                return math.inf
            continue
        one, other = (-size[axis] - p) / d, (size[axis] - p) / d
        enter, leave = max(enter, min(one, other)), min(leave, max(one, other))
    if enter > leave or leave < 0.0:
        return math.inf
    return enter if enter >= 0.0 else leave


@kernel
def _meet_ball(px, py, pz, dx, dy, dz, radius):
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
def _cast_triangles(origin, directions, triangles, reach2, distances):
    """Lower `distances` (n,) to the nearest triangle of (T, 3, 3), seen from either side (Moller and Trumbore 1997)."""
    for k in range(len(triangles)):
        a, b, c = triangles[k, 0], triangles[k, 1], triangles[k, 2]
        apart2 = 0.0
        for axis in range(3):
            low, high = min(a[axis], b[axis], c[axis]), max(a[axis], b[axis], c[axis])
            gap = max(max(low - origin[axis], origin[axis] - high), 0.0)
            apart2 += gap * gap
        if apart2 > reach2:
            continue
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        sx, sy, sz = origin[0] - a[0], origin[1] - a[1], origin[2] - a[2]
        qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
        last = vx * qx + vy * qy + vz * qz
        for n in range(len(directions)):
            dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
            hx, hy, hz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
            det = ux * hx + uy * hy + uz * hz
            if det == 0.0:
                continue
            share = 1.0 / det
            u = share * (sx * hx + sy * hy + sz * hz)
            if u < 0.0 or u > 1.0:
                continue
            v = share * (dx * qx + dy * qy + dz * qz)
            if v < 0.0 or u + v > 1.0:
                continue
            t = share * last
            if 0.0 <= t < distances[n]:
                distances[n] = t
