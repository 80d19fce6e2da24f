"""The walk of a ray through the hierarchy: nearest boxes first, closed forms in its leaves.

A GPU walks otherwise, one thread a ray, with what stands below `traverse` (`lidarsim.gpu.rays`).
"""

import math

import numpy as np

from lidarsim.engines.forms import meet, meet_ball, meet_plane, meet_triangle, normal, upright
from lidarsim.engines.hierarchy import WAITING, WIDTH
from lidarsim.jit import kernel
from lidarsim.solids.shapes import SPHERE

SPARE_LENGTH2 = 2e-6
"""How far the squared length of a unit vector may be from 1."""
ROUNDED = 1e-11
"""As far, and the vector is taken as it is: a `Pose`'s quaternion may leave that much, and its bits
stay. Beyond, it is made a unit vector."""
FARTHER = 1.0 - 2.0 * ROUNDED
"""What of a squared distance is left, at least, however it and the vector were rounded."""


@kernel
def traverse(
    origins,
    directions,
    max_range_m,
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
):
    """Fill ranges (P, n) and items (P, n) for directions (P, n, 3) from origins (P, 3); see
    `AnalyticEngine`.

    The rays of pose p pass through the items whose `part` is `through[p]`, unless that is -1.

    Numbers of nodes and items are unsigned: for signed ones numba allows for negative indices, a
    tenth of the time.
    """
    plain, none = np.uint64(len(shape)), np.uint64(len(shape) + len(triangles))
    waiting, closes = (
        np.empty(WAITING, np.uint64),
        np.empty(WAITING, np.uint64),
    )  # a node and 0, or items of a leaf
    begins = np.empty(WAITING)
    # nodes as they are from this pose, made where its first ray visits them; `met` says from which
    # pose they are
    near, met, kids = (
        np.empty_like(boxes),
        np.zeros(len(boxes), np.uint32),
        np.empty((len(boxes), WIDTH), np.uint64),
    )
    count = np.empty(len(boxes), np.uint64)
    for p in range(len(origins)):
        ox, oy, oz, own = origins[p, 0], origins[p, 1], origins[p, 2], through[p]
        if not abs(ox) + abs(oy) + abs(oz) < math.inf:
            continue
        for n in range(directions.shape[1]):
            x, y, z = directions[p, n, 0], directions[p, n, 1], directions[p, n, 2]
            length2 = x * x + y * y + z * z
            if not abs(length2 - 1.0) <= ROUNDED:
                if not abs(length2 - 1.0) <= SPARE_LENGTH2:
                    continue
                length = math.sqrt(length2)
                x, y, z = x / length, y / length, z / length
                directions[p, n, 0], directions[p, n, 1], directions[p, n, 2] = x, y, z
            ix, iy, iz = inverse(x), inverse(y), inverse(z)
            # the rows of a node's boxes where the ray comes in, and where it goes out
            ax = np.uint64(0 if ix > 0.0 else 3)
            ay = np.uint64(1 if iy > 0.0 else 4)
            az = np.uint64(2 if iz > 0.0 else 5)
            bx, by, bz = np.uint64(3) - ax, np.uint64(5) - ay, np.uint64(7) - az
            if plain < none:
                frame = upright(origins[p], directions[p, n])
            best, item = max_range_m, none
            for plane in planes:
                t = meet_plane(size[plane], position[plane], rotation[plane], ox, oy, oz, x, y, z)
                if (t < best or (t == best and plane < item)) and (own < 0 or part[plane] != own):
                    best, item = t, plane
            left = min(len(boxes), 1)
            waiting[0], closes[0], begins[0] = 0, 0, 0.0
            while left > 0:
                left -= 1
                if begins[left] > best:
                    continue
                node, close = waiting[left], closes[left]
                if close > 0:
                    for q in range(node, close):
                        g = order[q]
                        if g >= plain:
                            t = meet_triangle(triangles, g - plain, frame)
                        else:
                            sx, sy = ox - position[g, 0], oy - position[g, 1]
                            sz = oz - position[g, 2]
                            if passes(reach2[g], sx, sy, sz, x, y, z):
                                continue
                            t = meet_solid(g, shape, size, rotation, sx, sy, sz, x, y, z)
                        if (t < best or (t == best and g < item)) and (own < 0 or part[g] != own):
                            best, item = t, g
                    continue
                if met[node] != p + 1:
                    met[node] = p + 1
                    count[node] = _approach(
                        boxes[node], ox, oy, oz, max_range_m, near[node], kids[node]
                    )
                first = left
                for child in range(count[node]):
                    k = np.uint64(child)
                    # slabs (Kay and Kajiya 1986)
                    x0, x1 = near[node, ax, k] * ix, near[node, bx, k] * ix
                    y0, y1 = near[node, ay, k] * iy, near[node, by, k] * iy
                    z0, z1 = near[node, az, k] * iz, near[node, bz, k] * iz
                    begin = max(max(x0, y0), max(z0, 0.0))
                    if begin > min(min(x1, y1), min(z1, best)):
                        continue
                    j = left
                    while j > first and begins[j - 1] < begin:
                        waiting[j], closes[j], begins[j] = (
                            waiting[j - 1],
                            closes[j - 1],
                            begins[j - 1],
                        )
                        j -= 1
                    waiting[j], closes[j], begins[j] = (
                        links[node, kids[node, k]],
                        ends[node, kids[node, k]],
                        begin,
                    )
                    left += 1
            if item < none:
                ranges[p, n], items[p, n] = best, item


@kernel
def passes(reach2, sx, sy, sz, x, y, z):
    """Whether a ray from s along the unit vector (x, y, z) misses the ball about 0 of squared
    radius `reach2`, or leaves it behind: quicker than the solid in it."""
    along, apart2 = sx * x + sy * y + sz * z, sx * sx + sy * sy + sz * sz
    return apart2 * FARTHER - along * along > reach2 or (along > 0.0 and apart2 > reach2)


@kernel
def meet_solid(g, shape, size, rotation, sx, sy, sz, x, y, z):
    """Distance from s, seen from its centre, along the unit vector (x, y, z) to primitive g of n,
    which is no plane; inf where it is not met."""
    if shape[g] == SPHERE:
        return meet_ball(sx, sy, sz, x, y, z, size[g, 0])
    px = rotation[g, 0, 0] * sx + rotation[g, 1, 0] * sy + rotation[g, 2, 0] * sz
    py = rotation[g, 0, 1] * sx + rotation[g, 1, 1] * sy + rotation[g, 2, 1] * sz
    pz = rotation[g, 0, 2] * sx + rotation[g, 1, 2] * sy + rotation[g, 2, 2] * sz
    dx = rotation[g, 0, 0] * x + rotation[g, 1, 0] * y + rotation[g, 2, 0] * z
    dy = rotation[g, 0, 1] * x + rotation[g, 1, 1] * y + rotation[g, 2, 1] * z
    dz = rotation[g, 0, 2] * x + rotation[g, 1, 2] * y + rotation[g, 2, 2] * z
    return meet(shape[g], size[g, 0], size[g, 1], size[g, 2], px, py, pz, dx, dy, dz)


@kernel
def _approach(box, ox, oy, oz, reach, near, kids):
    """Fill `near` (6, 4) with the children's boxes (6, 4) relative to an origin, and `kids` (4,)
    with their places, but for those out of reach; how many there are."""
    count, far = np.uint64(0), reach * (1.0 + ROUNDED)  # a direction may be that much too long
    for child in range(WIDTH):
        k = np.uint64(child)
        x0, y0, z0 = box[0, k] - ox, box[1, k] - oy, box[2, k] - oz
        x1, y1, z1 = box[3, k] - ox, box[4, k] - oy, box[5, k] - oz
        if (
            max(max(max(x0, -x1), max(y0, -y1)), max(z0, -z1)) <= far and x0 <= x1
        ):  # else out of reach, or not there
            near[0, count], near[1, count], near[2, count] = x0, y0, z0
            near[3, count], near[4, count], near[5, count] = x1, y1, z1
            kids[count] = k
            count += np.uint64(1)
    return count


@kernel
def inverse(d):
    """1 / d, or what is as good and finite where the ray runs along the slab."""
    return 1.0 / d if abs(d) > 1e-300 else 1e300


@kernel
def normals_of(items, points, shape, size, position, rotation, triangles):
    """Unit normals (P, n, 3) at points (P, n, 3) of items (P, n); NaN where there is none."""
    normals = np.full(points.shape, np.nan)
    for p in range(items.shape[0]):
        for n in range(items.shape[1]):
            g, out = items[p, n], normals[p, n]
            if g >= len(shape):
                corners = triangles[g - len(shape)]
                ux, uy, uz = corners[1] - corners[0]
                vx, vy, vz = corners[2] - corners[0]
                out[:] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                out /= math.sqrt((out**2).sum())
            elif g >= 0:
                s, turn = points[p, n] - position[g], rotation[g]
                px, py, pz = (turn[:, 0] * s).sum(), (turn[:, 1] * s).sum(), (turn[:, 2] * s).sum()
                x, y, z = normal(shape[g], size[g, 0], size[g, 1], size[g, 2], px, py, pz)
                out[:] = turn[:, 0] * x + turn[:, 1] * y + turn[:, 2] * z
    return normals
