"""Distances of points and straight motions from the solids of a world: the collision check of
flights."""

import heapq
import math
from typing import Any

import numpy as np

from lidarsim.engines.voxels import FREE, UNKNOWN
from lidarsim.grid import Floats, Ints, Vector
from lidarsim.jit import kernel
from lidarsim.movers import COEFFICIENTS, Movers, find_piece, location, pose, velocity
from lidarsim.solids import Solids, joining, local
from scenegen.truth.shapes import distance
from scenegen.truth.triangles import crossing, triangle_distance

CELL_M = 2.0
"""Edge of the square cells, seen from above, into which solids are sorted."""
MAX_CELLS = 250_000
"""The greatest number of cells; in larger boxes, cells are larger."""
CAP_M = 1.0
"""Distances are exact up to this, and capped at it."""
STEP_S = 1e-3
"""Shortest step of a course's check, seconds."""
STEP_M = 1e-3
"""Shortest step of a motion check. Between two steps, a solid may be closer by this."""


class Clearance:
    """Distances to the solids of one world within a box.

    Solids are sorted into cells of the plan, so that a query examines only a few of them."""

    def __init__(self, solids: Solids, bounds: Floats):
        """Sort solids into cells.

        Args:
            solids: The world.
            bounds: (2, 3): least and greatest corner of the box of queries, metres.
        """
        low, high = bounds[0, :2], bounds[1, :2]
        extent = high - low
        # a long box has one cell across, however narrow it is: its length alone must keep the limit
        cell_m = max(
            CELL_M, float(np.sqrt(extent.prod() / MAX_CELLS)), float(extent.max()) / MAX_CELLS
        )
        cells = np.maximum(np.ceil(extent / cell_m).astype(np.int64), 1)
        corners = solids.triangles
        # boxes grown by the cap: a cell lists every solid that is within it of one of its points
        lower = np.concatenate([solids.lower, corners.min(axis=1)])[:, :2] - CAP_M
        upper = np.concatenate([solids.upper, corners.max(axis=1)])[:, :2] + CAP_M
        # so clipped, solids beside the box are in no cell, and those without bounds in all
        first = np.clip(np.floor((lower - low) / cell_m), 0, cells).astype(np.int64)
        last = np.clip(np.floor((upper - low) / cell_m), -1, cells - 1).astype(np.int64)
        start, item = _sorted_into_cells(first, last, cells)
        owner = np.repeat(np.arange(len(solids.mesh_filled)), np.diff(solids.mesh_start))
        # None spares numba the code for meshes, which few worlds have
        meshes = (solids.triangles, owner, solids.mesh_filled) if len(owner) else None
        # in the order of `_from_solids`; without its kernel, so that clearances can be pickled
        self._arguments: tuple[Any, ...] = (
            low,
            cell_m,
            cells,
            start,
            item,
            solids.shape,
            solids.size,
            solids.position,
            solids.rotation,
            meshes,
        )

    def at(self, x: float, y: float, z: float) -> float:
        """Compute the distance from a point to the nearest solid.

        Args:
            x: The point along x, metres.
            y: Along y, metres.
            z: Along z, metres.

        Returns:
            Metres, at most `CAP_M`; 0 inside a solid.
        """
        return float(_clearance(x, y, z, CAP_M, 0.0, self._arguments))

    def at_all(self, points: Floats) -> Floats:
        """Compute the distances of points from the nearest solid, see `at`.

        Args:
            points: (n, 3), metres.

        Returns:
            (n,) metres.
        """
        nearest = np.empty(len(points))
        _clearances(points, nearest, self._arguments)
        return nearest

    def motion_is_free(self, p: Vector, q: Vector, radius_m: float) -> bool:
        """Test whether a ball moved along a straight line stays clear of every solid.

        It walks by the distance still free, which no solid can undercut, in steps of at least
        `STEP_M`.

        Args:
            p: Start of its centre, metres.
            q: End of its centre, metres.
            radius_m: The ball's, below `CAP_M`.

        Returns:
            Whether it stays clear.
        """
        return bool(_motion_is_free(p, q, radius_m, self._arguments))

    def course_is_free(
        self, begin_s: Floats, course: Floats, end_s: float, balls: Floats, gap_m: float
    ) -> bool:
        """Test whether balls on a mover stay clear of every solid during its course.

        Time is halved until a ball cannot reach a solid in what is left of it, so a free course may
        be refused, and one that is not free never passes.

        Args:
            begin_s: (P,): when pieces begin, seconds.
            course: (P, 5, 4): as in `lidarsim.movers.Movers`; places of second degree at most, and
                headings that run along a chord.
            end_s: When the last piece ends, seconds.
            balls: (B, 4): centre in the mover's frame and radius, below `CAP_M`, metres.
            gap_m: How far they must stay away, metres.

        Returns:
            Whether they stay clear.
        """
        grown = balls + np.array([0.0, 0.0, 0.0, gap_m])
        return bool(_course_is_free(begin_s, course, end_s, grown, self._arguments))


def _lengths_s(movers: Movers) -> Floats:
    """How long each piece lasts, (P, 1) seconds; 0 for a last one that has no end."""
    lengths = np.diff(np.append(movers.begin_s, 0.0))
    last = movers.piece_start[1:] - 1
    lengths[last] = movers.period_s - movers.begin_s[last]
    return np.where(np.isfinite(lengths), lengths, 0.0)[:, None]


def heading_lengths(movers: Movers) -> Floats:
    """Compute the least length of the heading in each piece, before it is scaled to 1.

    Args:
        movers: The movers. Headings run along a chord in every piece.

    Returns:
        (P,): the distance of the chord from the origin.
    """
    u, (start, linear, square, cubic) = _lengths_s(movers), np.moveaxis(movers.course[:, 3:], 2, 0)
    chord = u * (linear + u * (square + u * cubic))
    # a constant heading has a chord of length 0
    squares = np.maximum((chord * chord).sum(axis=1), 1e-300)
    along = np.clip(-(start * chord).sum(axis=1) / squares, 0.0, 1.0)
    return np.asarray(np.sqrt(((start + along[:, None] * chord) ** 2).sum(axis=1)))


class MoversClearance:
    """Distances to movers, each where it is at a time."""

    def __init__(self, movers: Movers):
        """Bound how fast any point of the movers is.

        Args:
            movers: The movers. Their courses repeat, and headings run along a chord in every piece.
        """
        self._arguments = movers.bodies
        u, (_, linear, square, cubic) = _lengths_s(movers), np.moveaxis(movers.course, 2, 0)
        # control points of their slopes, parabolas, which no value exceeds
        controls = (linear, linear + u * square, linear + u * (2.0 * square + u * 3.0 * cubic))
        slopes = np.stack(controls)
        speed, turn = (
            np.sqrt((part * part).sum(axis=2)).max(axis=0)
            for part in (slopes[..., :3], slopes[..., 3:])
        )
        reach = np.repeat(movers.bodies[1], np.diff(movers.piece_start))
        # scaled to length 1, a heading turns the faster the shorter it is
        fastest = speed + turn / heading_lengths(movers) * reach
        self._fastest_mps = float(fastest.max(initial=0.0))

    def at(self, points: Floats, times_s: Floats) -> Floats:
        """Compute the distances of points from the nearest solid of a mover.

        Args:
            points: (n, 3), metres.
            times_s: (n,): the time of each point, seconds.

        Returns:
            (n,) metres, at most `CAP_M`; 0 inside a solid.
        """
        nearest = np.empty(len(points))
        _from_movers(points, times_s, nearest, self._arguments)
        return nearest

    def motion_is_free(
        self, p: Vector, q: Vector, times_s: tuple[float, float], radius_m: float
    ) -> bool:
        """Test whether a ball that moves evenly along a line stays clear of every mover.

        It walks by the time that ball and movers need at least for the distance still free, but at
        least the time for `STEP_M`.

        Args:
            p: Start of its centre, metres.
            q: End of its centre, metres.
            times_s: When it is at the start, and when at the end, seconds.
            radius_m: The ball's, below `CAP_M`.

        Returns:
            Whether it stays clear.
        """
        return bool(_motion_avoids(p, q, times_s, radius_m, self._fastest_mps, self._arguments))


def _sorted_into_cells(first: Ints, last: Ints, cells: Ints) -> tuple[Ints, Ints]:
    """List by cell the elements that reach into it.

    Compressed rows: item[start[c]:start[c + 1]] are those of cell c, rising."""
    # counts stand two places on: when the second visit has moved them, start[c] begins cell c
    start, columns = np.zeros(cells.prod() + 2, np.int64), cells[1]
    # an empty array, no None: for another type, numba would compile the kernel again
    _visit_cells(first, last, columns, start, np.empty(0, np.int64))
    np.cumsum(start, out=start)
    item = np.empty(start[-1], np.int64)
    _visit_cells(first, last, columns, start, item)
    return start[:-1], item


@kernel
def _visit_cells(first, last, columns, start, item):
    """Count in start[c + 2] the elements that reach into cell c; or, if `item` has room for them,
    put each in it at start[c + 1], which then moves on."""
    for n in range(len(first)):
        for i in range(first[n, 0], last[n, 0] + 1):
            for j in range(first[n, 1], last[n, 1] + 1):
                cell = i * columns + j
                if len(item) == 0:
                    start[cell + 2] += 1
                else:
                    item[start[cell + 1]] = n
                    start[cell + 1] += 1


@kernel
def _clearance(x, y, z, cap_m, enough_m, arguments):
    """Compute the distance of a point, up to `cap_m`; below `enough_m`, another solid may be
    nearer.

    Of the two branches, numba compiles only that for the `arguments`."""
    if len(arguments) == 4:
        return _from_voxels(x, y, z, cap_m, enough_m, *arguments)
    return _from_solids(x, y, z, *arguments)


@kernel
def _clearances(points, nearest, arguments):
    """Fill in the `_clearance` of each point."""
    for n in range(len(points)):
        x, y, z = points[n]
        nearest[n] = _clearance(x, y, z, CAP_M, 0.0, arguments)


@kernel
def _from_solids(
    x,
    y,
    z,
    low,
    cell_m,
    cells,
    start,
    item,
    shape,
    size,
    position,
    rotation,
    meshes,
):
    """`_clearance` among the solids of a `Clearance`, up to `CAP_M`. Without `meshes`, numba omits
    their code."""
    i = min(max(math.floor((x - low[0]) / cell_m), 0), cells[0] - 1)
    j = min(max(math.floor((y - low[1]) / cell_m), 0), cells[1] - 1)
    cell = i * cells[1] + j
    nearest = CAP_M
    mesh, winding = -1, 0
    for entry in range(start[cell], start[cell + 1]):
        n = item[entry]
        if n < len(shape):
            dx, dy, dz = local(rotation[n], *joining(position[n], (x, y, z)))
            nearest = min(nearest, distance(shape[n], size[n], dx, dy, dz))
        elif meshes is not None:
            triangles, owner, filled = meshes
            t = triangles[n - len(shape)]
            m = owner[n - len(shape)]
            nearest = min(nearest, triangle_distance(t[0], t[1], t[2], x, y, z))
            # the triangles of a mesh follow one another, so its winding number is complete here
            if m != mesh:
                if winding != 0:
                    return 0.0
                mesh, winding = m, 0
            if filled[m]:
                sign, height = crossing(t[0], t[1], t[2], x, y)
                # crossings above the point: their sum is the winding number around it
                if sign != 0 and height > z:
                    winding += sign
    return 0.0 if winding != 0 else nearest


@kernel
def _from_voxels(x, y, z, cap_m, enough_m, states, voxel_m, origin, opened):
    """`_clearance` in a map of voxels. Voxels that are not free count as solids; in an `opened`
    map, only the occupied ones."""
    nx, ny, nz = states.shape
    sx, sy, sz = (x - origin[0]) / voxel_m, (y - origin[1]) / voxel_m, (z - origin[2]) / voxel_m
    nearest, enough = cap_m / voxel_m, enough_m / voxel_m
    i, j, k = math.floor(sx), math.floor(sy), math.floor(sz)
    # shells of voxels around the point's own, until the next one is farther than the nearest solid
    for shell in range(math.ceil(nearest) + 1):
        if shell - 1 >= nearest or nearest < enough:
            break
        for a in range(i - shell, i + shell + 1):
            for b in range(j - shell, j + shell + 1):
                side = abs(a - i) == shell or abs(b - j) == shell
                # on the shell only: inner layers have just its top and bottom
                step = 1 if side or shell == 0 else 2 * shell
                for c in range(k - shell, k + shell + 1, step):
                    inside = 0 <= a < nx and 0 <= b < ny and 0 <= c < nz
                    state = states[a, b, c] if inside else UNKNOWN
                    if state == FREE or (opened and state == UNKNOWN):
                        continue
                    u = max(max(a - sx, sx - (a + 1)), 0.0)
                    v = max(max(b - sy, sy - (b + 1)), 0.0)
                    w = max(max(c - sz, sz - (c + 1)), 0.0)
                    nearest = min(nearest, math.sqrt(u * u + v * v + w * w))
    return nearest * voxel_m


@kernel
def widest(begin, reach, cap_m, arguments):
    """Compute the width of the widest way through a map's free voxels, from middle to middle.

    Prim's search (1957): the widest voxel first, of equally wide ones the farthest.

    Args:
        begin: The first voxel, three numbers.
        reach: The way ends this many voxels away.
        cap_m: Widths are capped at this, metres.
        arguments: States (nx, ny, nz), `voxel_m`, `origin` and `opened`, as of `PlaceClearance`.

    Returns:
        The way's least distance to voxels that are not free, metres; 0 if there is no way.
    """
    states, voxel_m, origin, _ = arguments
    seen = np.zeros(states.shape, np.bool_)
    # heapq pops the least, so widths and distances are negative
    width, waiting = cap_m, [(-cap_m, 0, *begin)]
    while len(waiting) > 0:
        lack, far, i, j, k = heapq.heappop(waiting)
        width = min(width, -lack)
        if -far >= reach * reach or width <= 0.0:
            return width
        for d in range(6):
            step = 1 - 2 * (d & 1)
            a, b, c = i + step * (d < 2), j + step * (d // 2 == 1), k + step * (d > 3)
            inside = 0 <= a < len(states) and 0 <= b < states.shape[1] and 0 <= c < states.shape[2]
            # its width and distance are the same from every side, so it waits only once
            if inside and not seen[a, b, c]:
                seen[a, b, c] = True
                x, y, z = (
                    origin[0] + (a + 0.5) * voxel_m,
                    origin[1] + (b + 0.5) * voxel_m,
                    origin[2] + (c + 0.5) * voxel_m,
                )
                free = _clearance(x, y, z, cap_m, 0.0, arguments)
                far = (a - begin[0]) ** 2 + (b - begin[1]) ** 2 + (c - begin[2]) ** 2
                heapq.heappush(waiting, (-free, -far, a, b, c))
    return 0.0


@kernel
def _motion_is_free(p, q, radius, arguments):
    dx, dy, dz = joining(p, q)
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    # the walk below cannot pass a point that is closer than asked by two of its steps, and most
    # motions that it would refuse have one here
    too_near = radius - 2 * STEP_M
    for s in (1.0, 0.5):
        x, y, z = p[0] + s * dx, p[1] + s * dy, p[2] + s * dz
        if _clearance(x, y, z, radius, too_near, arguments) < too_near:
            return False
    t = 0.0
    while True:
        s = min(t / length, 1.0) if length > 0.0 else 1.0
        x, y, z = p[0] + s * dx, p[1] + s * dy, p[2] + s * dz
        free = _clearance(x, y, z, CAP_M, 0.0, arguments) - radius
        if free < 0.0:
            return False
        if s >= 1.0:
            return True
        # without a least step, the walk towards a surface would never arrive
        t = min(t + max(free, STEP_M), length)


@kernel
def _course_is_free(begin_s, course, end_s, balls, arguments):
    """See `Clearance.course_is_free`."""
    for piece in range(len(begin_s)):
        last = begin_s[piece + 1] if piece + 1 < len(begin_s) else end_s
        whole = last - begin_s[piece]
        turns = False
        for power in range(1, COEFFICIENTS):
            turns |= course[piece, 3, power] != 0.0 or course[piece, 4, power] != 0.0
        # a constant heading, computed once a piece: its steps are many
        _, _, _, cosine, sine = pose(course, piece, 0.0)
        for ball in range(len(balls)):
            bx, by = balls[ball, 0], balls[ball, 1]
            begin, step = 0.0, whole
            while begin < whole:
                end = min(begin + step, whole)
                middle = 0.5 * (begin + end)
                x, y, z = location(course, piece, middle)
                # the speed is greatest at an end, and so is the turn from the middle
                swing = 0.0
                speed = 0.0
                if turns:
                    _, _, _, cosine, sine = pose(course, piece, middle)
                for time in (begin, end):
                    u, v, w = velocity(course, piece, time)
                    speed = max(speed, math.sqrt(u * u + v * v + w * w))
                    if turns:
                        _, _, _, c, s = pose(course, piece, time)
                        swing = max(swing, math.sqrt((c - cosine) ** 2 + (s - sine) ** 2))
                reach = speed * (end - middle) + swing * math.sqrt(bx * bx + by * by)
                x += cosine * bx - sine * by
                y += sine * bx + cosine * by
                z += balls[ball, 2]
                free = _clearance(x, y, z, CAP_M, 0.0, arguments) - balls[ball, 3]
                if free >= reach:
                    # a wide place may follow a narrow one, so steps grow again
                    begin, step = end, 2.0 * (end - begin)
                # what the shortest step cannot settle is refused: what passes is surely free
                elif free < 0.0 or end - begin < STEP_S:
                    return False
                else:
                    step = 0.5 * (end - begin)
    return True


@kernel
def _near_movers(x, y, z, time, arguments):
    """The distance of a point from the nearest mover, up to `CAP_M`."""
    courses, reach, solid_start, shape, size, offset = arguments
    nearest = CAP_M
    for m in range(len(reach)):
        piece, u, px, py, pz = find_piece(m, time, courses)
        dx, dy, dz = x - px, y - py, z - pz
        # most movers are far away: their ball spares the turn and the solids
        if math.sqrt(dx * dx + dy * dy + dz * dz) - reach[m] >= nearest:
            continue
        _, _, _, hx, hy = pose(courses[3], piece, u)
        # to the mover's frame: the transpose of a turn about the vertical
        qx, qy = hx * dx + hy * dy, hx * dy - hy * dx
        for s in range(solid_start[m], solid_start[m + 1]):
            ox, oy, oz = qx - offset[s, 0], qy - offset[s, 1], dz - offset[s, 2]
            nearest = min(nearest, distance(shape[s], size[s], ox, oy, oz))
    return nearest


@kernel
def _from_movers(points, times, nearest, arguments):
    for n in range(len(points)):
        nearest[n] = _near_movers(points[n, 0], points[n, 1], points[n, 2], times[n], arguments)


@kernel
def _motion_avoids(p, q, times, radius, fastest, arguments):
    """See `MoversClearance.motion_is_free`."""
    begin, end = times
    dx, dy, dz = joining(p, q)
    speed = math.sqrt(dx * dx + dy * dy + dz * dz) / (end - begin) + fastest
    time = begin
    while True:
        s = (time - begin) / (end - begin)
        x, y, z = p[0] + s * dx, p[1] + s * dy, p[2] + s * dz
        free = _near_movers(x, y, z, time, arguments) - radius
        if free < 0.0:
            return False
        if time >= end:
            return True
        # at least a millimetre a second: time goes on where nothing moves
        time = min(time + max(free, STEP_M) / max(speed, STEP_M), end)
