"""The walk of rays through the hierarchy: neighbours together, nearest boxes first, closed forms in
the leaves.

Rays of a pose that run nearly the same way are walked as one packet (Wald et al. 2001). A box or a
solid is skipped if it lies beside the pyramid around them all (Reshetov et al. 2005). Each ray
meets the rest by itself, so that packets change no bit."""

import math
from typing import Any

import numpy as np

from lidarsim.engines.forms import (
    axes,
    meet,
    meet_ball,
    meet_plane,
    meet_triangle,
    surface_normal,
    upright,
)
from lidarsim.engines.hierarchy import WAITING, WIDTH
from lidarsim.jit import kernel
from lidarsim.solids import SPHERE, joining, local

SPARE_LENGTH2 = 2e-6
"""How far the squared length of a unit vector may be from 1."""
ROUNDED = 1e-11
"""Vectors whose squared length is within this of 1 keep their bits: a `Pose`'s quaternion may leave
that much. Others are scaled to length 1."""
FARTHER = 1.0 - 2.0 * ROUNDED
"""Lower bound of a squared distance after rounding, as a share of it."""
NEGLIGIBLE = 1e-20
"""Padding of a ball's squared radius against rounding, as a share of its squared distance."""
TILE = 4
"""Rows and columns of rays that are walked together."""
LANES = TILE * TILE
"""The most rays of a packet."""
STEEP = 0.3
"""The least cosine between a packet's rays and its axis."""
SPREAD = 1.5
"""The greatest width of a packet after a metre along its axis, metres."""
WORTH = 16
"""A packet that takes more steps than this for each of its rays gains nothing and is split: among
small triangles, single rays are faster."""
PATIENCE = 8
"""The number of packets that must succeed before larger ones are tried."""


def work_arrays() -> tuple[Any, ...]:
    """Make the arrays that `traverse` works in.

    They are made here, since numba takes half a second to compile their creation. Of every lane, a
    ray of the packet: its direction and the inverse of that, its number, the distance of the
    nearest item so far, that item (the count of items for none), and whether it missed the last
    one. Then the stack of children to be entered, the nearest last, and the distances where they
    begin; and where the children of one node begin."""
    return (
        np.empty((6, LANES)),
        np.empty(LANES, np.uint64),
        np.empty(LANES),
        np.empty(LANES, np.uint64),
        np.empty(LANES, np.bool_),
        np.empty(WAITING, np.uint64),
        np.empty(WAITING),
        np.empty(WIDTH),
    )


@kernel
def traverse(
    origins,
    directions,
    max_range_m,
    turn,
    shape,
    size,
    position,
    rotation,
    reach2,
    planes,
    triangles,
    boxes,
    links,
    ends,
    order,
    part,
    through,
    ranges,
    items,
    work,
):
    """Fill ranges (P, n) and items (P, n) of rays. A ray that meets nothing leaves both unchanged.

    Args:
        origins: (P, 3), metres, in the world. A pose that is not finite meets nothing.
        directions: (P, n, 3), in the world. Vectors that are not nearly of unit length meet
            nothing; the others are scaled to it in place.
        max_range_m: How far rays go, metres.
        turn: (n,): the numbers of rays, neighbours one after the other.
        shape, size, position, rotation: Of the m primitives: (m,), (m, 3), (m, 3), (m, 3, 3). Items
            from m on are triangles.
        reach2: (m,): squared radii of the balls around them.
        planes: Numbers of those primitives that are planes, which no box holds.
        triangles: (k, 3, 3).
        boxes, links, ends: The hierarchy: of each node, its children's boxes (nodes, 6, WIDTH), and
            what each child is (nodes, WIDTH): the node `links`, or where `ends` is above 0 a leaf,
            with the items from `links` up to `ends` in `order`.
        order: The items, leaf by leaf.
        part: (items,): the part of the scene that an item belongs to.
        through: (P,): the part whose items a pose's rays pass through; -1 for none.
        ranges, items: Results, (P, n) each.
        work: From `work_arrays`.

    Numbers of nodes, items and lanes are unsigned: for signed ones numba allows for negative
    indices, a tenth of the time. Tests over children and over lanes have no branches: the processor
    could not predict them, and a wrong prediction costs more than the test saves.
    """
    plain, none = np.uint64(len(shape)), np.uint64(len(shape) + len(triangles))
    wide, root = np.uint64(WIDTH), np.uint64(WIDTH * len(boxes))
    ray, lanes, best, item, missed, waiting, begins, near = work
    for pose in range(len(origins)):
        origin, skipped = origins[pose], through[pose]
        ox, oy, oz = origin[0], origin[1], origin[2]
        if not abs(ox) + abs(oy) + abs(oz) < math.inf:
            continue
        # packets of up to `limit` rays: halved where one gains nothing, doubled after `PATIENCE`
        # that succeed
        start, limit, patience = 0, LANES, 0
        while start < len(turn):
            end = min(start + limit, len(turn))
            count, u, v, w, u0, u1, v0, v1, slowest, fastest = _pack(
                directions[pose], turn[start:end], ray, lanes
            )
            if count == 0:  # none of them is a unit vector
                start = end
                continue
            # rays that run too far apart are packed anew, fewer at a time
            if count > 1 and not (slowest >= STEEP and max(u1 - u0, v1 - v0) <= SPREAD):
                limit, patience = limit // 2, 0
                continue
            # planes have no end, and so no box: every ray meets them first
            for i in range(count):
                best[i], item[i] = max_range_m, none
                for g in planes:
                    if skipped >= 0 and part[g] == skipped:
                        continue
                    x, y, z = ray[0, i], ray[1, i], ray[2, i]
                    sx, sy, sz = joining(position[g], origin)
                    t = meet_plane(g, size, rotation, sx, sy, sz, x, y, z)
                    if _nearer(t, g, best[i], item[i]):
                        best[i], item[i] = t, g
                if plain < none:
                    for a in range(3):
                        ray[3 + a, i] = inverse(ray[a, i])
            # what begins farther away than this, no ray of the packet has use for
            worst = best[0]
            for i in range(1, count):
                worst = max(worst, best[i])
            # seen along w, the pyramid spreads along u and v: where it comes into boxes, where out
            sign, pace = 1.0 if ray[w, 0] > 0.0 else -1.0, 1.0 / fastest
            ou, ov, ow = origin[u], origin[v], origin[w]
            aw, _, bw, _, _ = _sides(w, sign, sign)
            au, fu, bu, gu, both_u = _sides(u, u0, u1)
            av, fv, bv, gv, both_v = _sides(v, v0, v1)
            long_u0, long_u1 = math.sqrt(1.0 + u0 * u0), math.sqrt(1.0 + u1 * u1)
            long_v0, long_v1 = math.sqrt(1.0 + v0 * v0), math.sqrt(1.0 + v1 * v1)
            pending, steps = min(len(boxes), 1), WORTH * np.int64(count)
            waiting[0], begins[0] = root, 0.0
            while pending > 0:
                pending -= 1
                if begins[pending] > worst:
                    continue
                steps -= 1
                if steps < 0 and count > 1:
                    break
                # the child `slot` of the node `parent`: a node, or the items of a leaf up to `stop`
                parent, slot = waiting[pending] // wide, waiting[pending] % wide
                node, stop = np.uint64(0), np.uint64(0)
                if waiting[pending] < root:
                    node, stop = links[parent, slot], ends[parent, slot]
                if stop > 0:
                    for q in range(node, stop):
                        g = order[q]
                        if g >= plain or (skipped >= 0 and part[g] == skipped):
                            continue
                        # the primitive's ball, against the four sides of the pyramid, its tip and
                        # its end
                        sx, sy, sz = ox - position[g, 0], oy - position[g, 1], oz - position[g, 2]
                        apart2 = sx * sx + sy * sy + sz * sz
                        radius = math.sqrt(reach2[g] + NEGLIGIBLE * apart2)
                        cu, cv = position[g, u] - ou, position[g, v] - ov
                        cw = sign * (position[g, w] - ow)
                        if (
                            (cu - u1 * cw > radius * long_u1)
                            | (u0 * cw - cu > radius * long_u0)
                            | (cv - v1 * cw > radius * long_v1)
                            | (v0 * cw - cv > radius * long_v0)
                            | (cw < -radius)
                            | (apart2 > (worst + radius) * (worst + radius))
                        ):
                            continue
                        # then against each ray; what is left is met in closed form
                        for i in range(count):
                            reach = best[i] + radius
                            missed[i] = (apart2 > reach * reach) | passes(
                                reach2[g], sx, sy, sz, ray[0, i], ray[1, i], ray[2, i]
                            )
                        for i in range(count):
                            if missed[i]:
                                continue
                            x, y, z = ray[0, i], ray[1, i], ray[2, i]
                            t = meet_solid(g, shape, size, rotation, sx, sy, sz, x, y, z)
                            if _nearer(t, g, best[i], item[i]):
                                best[i], item[i] = t, g
                    # the triangles of the leaf, by those rays that meet its box
                    if plain < none:
                        x0, x1 = boxes[parent, 0, slot] - ox, boxes[parent, 3, slot] - ox
                        y0, y1 = boxes[parent, 1, slot] - oy, boxes[parent, 4, slot] - oy
                        z0, z1 = boxes[parent, 2, slot] - oz, boxes[parent, 5, slot] - oz
                        for i in range(count):
                            a0, a1 = x0 * ray[3, i], x1 * ray[3, i]
                            b0, b1 = y0 * ray[4, i], y1 * ray[4, i]
                            c0, c1 = z0 * ray[5, i], z1 * ray[5, i]
                            enter = max(max(min(a0, a1), min(b0, b1)), max(min(c0, c1), 0.0))
                            leave = min(min(max(a0, a1), max(b0, b1)), min(max(c0, c1), best[i]))
                            missed[i] = enter > leave
                        for i in range(count):
                            if missed[i]:
                                continue
                            frame = upright(origin, ray[:3, i])
                            for q in range(node, stop):
                                g = order[q]
                                if g < plain or (skipped >= 0 and part[g] == skipped):
                                    continue
                                t = meet_triangle(triangles, g - plain, frame)
                                if _nearer(t, g, best[i], item[i]):
                                    best[i], item[i] = t, g
                    worst = best[0]
                    for i in range(1, count):
                        worst = max(worst, best[i])
                    continue
                for child in range(WIDTH):
                    k = np.uint64(child)
                    # slabs (Kay and Kajiya 1986) of all slopes at once
                    c0, c1 = (boxes[node, aw, k] - ow) * sign, (boxes[node, bw, k] - ow) * sign
                    a0, a1 = (boxes[node, au, k] - ou) * fu, (boxes[node, bu, k] - ou) * gu
                    b0, b1 = (boxes[node, av, k] - ov) * fv, (boxes[node, bv, k] - ov) * gv
                    enter = max(max(c0, 0.0), max(a0, b0))
                    enter = max(enter, max(a1 if both_u else 0.0, b1 if both_v else 0.0))
                    leave = min(c1, min(math.inf if both_u else a1, math.inf if both_v else b1))
                    near[k] = math.inf if enter > leave else enter * pace
                # the children that are met join the stack, farthest first
                first = pending
                for child in range(WIDTH):
                    k = np.uint64(child)
                    if near[k] > worst:
                        continue
                    j = pending
                    while j > first and begins[j - 1] < near[k]:
                        waiting[j], begins[j] = waiting[j - 1], begins[j - 1]
                        j -= 1
                    waiting[j], begins[j] = node * wide + k, near[k]
                    pending += 1
            # given up on the way: these rays are walked again, fewer at a time
            if steps < 0 and count > 1:
                limit, patience = limit // 2, 0
                continue
            for i in range(count):
                if item[i] < none:
                    ranges[pose, lanes[i]], items[pose, lanes[i]] = best[i], item[i]
            start, patience = end, patience + 1
            if patience == PATIENCE:
                limit, patience = min(2 * limit, LANES), 0


@kernel
def _pack(directions, turn, ray, lanes):
    """Put unit vectors of the rays `turn` in the columns of `ray` (6, lanes), and their numbers in
    `lanes`; skip vectors of other lengths.

    Returns the count of rays; the axes u, v and w, along which they run fastest; their least and
    greatest slopes along u and v for a metre along w; and how far the slowest and the fastest run
    along w for a metre of their own."""
    count, x, y, z = np.uint64(0), 0.0, 0.0, 0.0
    for n in turn:
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        length2 = dx * dx + dy * dy + dz * dz
        if not abs(length2 - 1.0) <= ROUNDED:
            if not abs(length2 - 1.0) <= SPARE_LENGTH2:
                continue
            length = math.sqrt(length2)
            dx, dy, dz = dx / length, dy / length, dz / length
            directions[n, 0], directions[n, 1], directions[n, 2] = dx, dy, dz
        ray[0, count], ray[1, count], ray[2, count], lanes[count] = dx, dy, dz, n
        x, y, z, count = x + dx, y + dy, z + dz, count + np.uint64(1)
    # of the sum of all rays, the packet's direction
    u, v, w = axes(x, y, z)
    sign = 1.0 if ray[w, 0] > 0.0 else -1.0
    u0, u1, v0, v1, slowest, fastest = math.inf, -math.inf, math.inf, -math.inf, math.inf, 0.0
    for i in range(count):
        d = sign * ray[w, i]
        a, b = ray[u, i] / d, ray[v, i] / d
        u0, u1, v0, v1 = min(u0, a), max(u1, a), min(v0, b), max(v1, b)
        slowest, fastest = min(slowest, d), max(fastest, d)
    return count, u, v, w, u0, u1, v0, v1, slowest, fastest


@kernel
def _sides(axis, low, high):
    """Return where a pyramid with slopes from `low` to `high` along an axis enters a box.

    That is the row of a node's boxes that it meets first and the inverse of the steepest slope
    towards it; the other row and the inverse of the other slope; and whether slopes have both
    signs: then it enters at either side, and leaves at none."""
    above = axis + np.uint64(3)
    if low >= 0.0:
        return axis, inverse(high), above, inverse(low), False
    if high <= 0.0:
        return above, inverse(low), axis, -inverse(-high), False
    return axis, inverse(high), above, -inverse(-low), True


@kernel
def _nearer(t, g, best, item):
    """Return whether item g at t comes before `item` at `best`; the lower number wins a tie."""
    return t < best or (t == best and g < item)


@kernel
def passes(reach2, sx, sy, sz, x, y, z):
    """Test whether a ray misses a ball about 0, or leaves it behind: quicker than the solid in it.

    Args:
        reach2: The ball's squared radius, m².
        sx, sy, sz: Where the ray begins, metres.
        x, y, z: Its direction, a unit vector.

    Returns:
        True if the ray surely misses.
    """
    along, apart2 = sx * x + sy * y + sz * z, sx * sx + sy * sy + sz * sz
    return apart2 * FARTHER - along * along > reach2 or (along > 0.0 and apart2 > reach2)


@kernel
def meet_solid(g, shape, size, rotation, sx, sy, sz, x, y, z):
    """Find the distance to a primitive that is not a plane.

    Args:
        g: The primitive's number.
        shape, size, rotation: Of the n primitives: (n,), (n, 3), (n, 3, 3).
        sx, sy, sz: Where the ray begins, relative to its centre, world axes, metres.
        x, y, z: Its direction, a unit vector in the world.

    Returns:
        Metres; inf where the ray misses.
    """
    # a ball looks the same in every frame
    if shape[g] == SPHERE:
        return meet_ball(sx, sy, sz, x, y, z, size[g, 0])
    px, py, pz = local(rotation[g], sx, sy, sz)
    dx, dy, dz = local(rotation[g], x, y, z)
    return meet(shape[g], size[g, 0], size[g, 1], size[g, 2], px, py, pz, dx, dy, dz)


@kernel
def inverse(d):
    """Return 1 / d, or a large finite number for a ray parallel to the slab, to avoid 0 · inf."""
    return 1.0 / d if abs(d) > 1e-300 else 1e300


@kernel
def surfaces_of(
    items, ranges, starts, rays, shape, size, position, rotation, triangles, points, normals
):
    """Compute points and normals of the surfaces that rays of P poses met.

    Args:
        items: (P, n): what each ray met, as `traverse` numbers it; negative for nothing.
        ranges: (P, n), metres.
        starts: (P, 3), metres, in the world.
        rays: (P, n, 3), unit vectors in the world.
        shape, size, position, rotation, triangles: As for `traverse`.
        points, normals: Results, (P, n, 3) each, in the world; NaN where nothing was met.
    """
    for p in range(len(starts)):
        for n in range(items.shape[1]):
            g, point = items[p, n], points[p, n]
            if g < 0:
                point[:] = np.nan
                normals[p, n, :] = np.nan
                continue
            for axis in range(3):
                point[axis] = starts[p, axis] + ranges[p, n] * rays[p, n, axis]
            if g >= len(shape):
                a, b, c = triangles[g - len(shape)]
                ux, uy, uz = joining(a, b)
                vx, vy, vz = joining(a, c)
                # the cross product of two edges
                x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                length = math.sqrt(x * x + y * y + z * z)
                for axis, part in enumerate((x, y, z)):
                    normals[p, n, axis] = part / length
            else:
                sx, sy, sz = joining(position[g], point)
                px, py, pz = local(rotation[g], sx, sy, sz)
                x, y, z = surface_normal(shape[g], size[g, 0], size[g, 1], size[g, 2], px, py, pz)
                for axis in range(3):
                    # the rotation takes the normal to the world's frame
                    turn = rotation[g, axis]
                    normals[p, n, axis] = turn[0] * x + turn[1] * y + turn[2] * z
