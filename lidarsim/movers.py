"""Solids that move along known courses, and rays that meet each of them where it is at the ray's
own time.

The place of a mover is a piecewise polynomial of time, and its heading is one that is scaled to
length 1. Only + - * / and square roots are used, so all results have the same bits on every
processor. A ray is taken to the mover's frame at the ray's time, and met there by the closed forms
of `lidarsim.engines.forms`: no time is divided into slices."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.engines import Caster
from lidarsim.engines.analytic import Hits
from lidarsim.engines.forms import meet, squared_reaches, surface_normal
from lidarsim.engines.traverse import FARTHER
from lidarsim.grid import Floats, Ints, Mask, rays_of
from lidarsim.jit import kernel
from lidarsim.solids import Solids, bounding_boxes, joining

if TYPE_CHECKING:
    import mujoco

COEFFICIENTS = 4
"""Of a polynomial in seconds since its piece began: constant, linear, quadratic, cubic."""
CHANNELS = 5
"""Polynomials of a piece: x, y, z in metres, and the heading's x and y, of any length above 0."""


@dataclass(frozen=True, eq=False)
class Movers:
    """M moving bodies of S solids in all, and their courses without jumps of P pieces in all.

    A course holds for all times: it repeats after `period_s`, a power of two, or, where that is
    inf, its first and last piece hold before and after their own times."""

    kind: Ints
    """(M,): numbers from 1 on, which the user gives a meaning."""
    owner: Ints
    """(S,): the mover of each solid, rising."""
    shape: Ints
    """(S,): codes of `lidarsim.solids`, planes excepted."""
    size: Floats
    """(S, 3): MuJoCo's sizes, metres."""
    offset: Floats
    """(S, 3): the solid's centre in the mover's frame, metres: x ahead, z up. Solids stand upright
    in that frame."""
    piece_start: Ints
    """(M + 1,): mover m has the pieces piece_start[m] to piece_start[m + 1]."""
    begin_s: Floats
    """(P,): when each piece begins, rising in each mover; the first at 0 where courses repeat."""
    course: Floats
    """(P, CHANNELS, COEFFICIENTS); places have no cubic term."""
    period_s: float = math.inf

    def __len__(self) -> int:
        return len(self.piece_start) - 1

    def poses(self, time_s: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Compute where all movers are, and how they move.

        Args:
            time_s: The time, seconds.

        Returns:
            Positions (M, 3), metres; headings (M, 2), unit vectors x and y; velocities (M, 3),
            metres a second; rates of turn (M,), radians a second, counter-clockwise from above.
        """
        result = np.empty((len(self), 9))
        _poses(float(time_s), self._courses, result)
        return result[:, :3], result[:, 3:5], result[:, 5:8], result[:, 8]

    def solids(self, time_s: float) -> Solids:
        """Compute where all solids are.

        Args:
            time_s: The time, seconds.

        Returns:
            S primitives; `geom` holds the movers that they belong to.
        """
        position, heading, _, _ = self.poses(time_s)
        cosine, sine = heading[self.owner].T
        rotation = np.zeros((len(self.owner), 3, 3))
        rotation[:, 0, 0], rotation[:, 0, 1] = cosine, -sine
        rotation[:, 1, 0], rotation[:, 1, 1], rotation[:, 2, 2] = sine, cosine, 1.0
        x, y, z = self.offset.T
        moved = np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)
        centre = position[self.owner] + moved
        box = bounding_boxes(self.shape, self.size, centre, rotation)
        return Solids(
            self.shape,
            self.size,
            centre,
            rotation,
            *box,
            triangles=np.empty((0, 3, 3)),
            mesh_start=np.zeros(1, np.int64),
            mesh_filled=np.empty(0, bool),
            geom=self.owner,
        )

    def distances_m(self, points: Floats, time_s: float, lasting_s: float = 0.0) -> Floats:
        """Bound from below how near movers come to points.

        Args:
            points: (n, 3), metres.
            time_s: The time, seconds.
            lasting_s: For how long after it, seconds.

        Returns:
            Metres (n,) to the nearest ball that holds a mover; inf without movers.
        """
        balls = self._balls_while(time_s, time_s + lasting_s)
        between = points[:, None] - balls[:, :3]
        away = np.sqrt((between * between).sum(axis=2)) - np.sqrt(balls[:, 3])
        return np.min(away, axis=1, initial=np.inf)

    def window(self, begin_s: float, end_s: float) -> "Movers":
        """Cut the courses to an interval of time from 0 on. Within it, poses have the same bits.

        Args:
            begin_s: Its begin, seconds.
            end_s: Its end, seconds.

        Returns:
            Movers that do not repeat.
        """
        starts, begins, courses = [0], list[Floats](), list[Floats]()
        repeats = math.isfinite(self.period_s)
        if repeats:
            rounds = np.arange(begin_s // self.period_s, end_s // self.period_s + 1)
        for first, last in zip(self.piece_start[:-1], self.piece_start[1:], strict=True):
            begin = self.begin_s[first:last]
            if repeats:
                # begins are multiples of a power of two, as periods are: sums are exact
                begin = (rounds[:, None] * self.period_s + begin).reshape(-1)
            after, high = np.searchsorted(begin, (begin_s, end_s), side="right").tolist()
            low = max(after - 1, 0)
            begins.append(begin[low:high])
            courses.append(self.course[first + np.arange(low, high) % (last - first)])
            starts.append(starts[-1] + high - low)
        return replace(
            self,
            piece_start=np.array(starts),
            begin_s=np.concatenate([np.empty(0), *begins]),
            course=np.concatenate([np.empty((0, CHANNELS, COEFFICIENTS)), *courses]),
            period_s=math.inf,
        )

    def only(self, chosen: Mask) -> "Movers":
        """Keep some movers.

        Args:
            chosen: (M,): whether each is kept.

        Returns:
            Those movers, numbered anew.
        """
        counts, solids = np.diff(self.piece_start), chosen[self.owner]
        pieces = np.repeat(chosen, counts)
        return replace(
            self,
            kind=self.kind[chosen],
            owner=(np.cumsum(chosen) - 1)[self.owner[solids]],
            shape=self.shape[solids],
            size=self.size[solids],
            offset=self.offset[solids],
            piece_start=np.append(0, np.cumsum(counts[chosen])),
            begin_s=self.begin_s[pieces],
            course=self.course[pieces],
        )

    def gaps_m(self, point: Floats, time_s: float) -> Floats:
        """Compute how far a point is from the box around each mover.

        Args:
            point: (3,), metres, in the world.
            time_s: The time, seconds.

        Returns:
            (M,), metres; 0 inside. See `boxes`.
        """
        position, heading, _, _ = self.poses(time_s)
        (x, y, z), (cosine, sine) = (point - position).T, heading.T
        within = np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)
        lower, upper = self.boxes
        beyond = np.maximum(np.maximum(lower - within, within - upper), 0.0)
        return np.asarray(np.sqrt((beyond * beyond).sum(axis=1)))

    def nearest(
        self, starts: Floats, rays: Floats, times_s: Floats, ranges: Floats
    ) -> tuple[Floats, Ints]:
        """Find the solid that each ray of P poses meets first, if it is nearer than what it met
        before.

        Args:
            starts: (P, 3), metres, in the world.
            rays: (P, n, 3), unit vectors in the world.
            times_s: (n,): the time of each ray, seconds; or (1,) for all.
            ranges: (P, n): metres up to which a solid is looked for.

        Returns:
            Ranges (P, n), metres, `ranges` where no mover is nearer; the solid met (P, n), -1 for
            none.
        """
        nearer, solid = ranges.copy(), np.full(ranges.shape, -1)
        if len(self) and ranges.size:
            _nearest(
                starts,
                rays,
                times_s,
                self._courses,
                (self.solid_start, self.shape, self.size, self.offset),
                self._balls_while(float(times_s.min()), float(times_s.max())),
                nearer,
                solid,
            )
        return nearer, solid

    def surfaces(
        self, starts: Floats, rays: Floats, times_s: Floats, ranges: Floats, solid: Ints
    ) -> tuple[Floats, Floats]:
        """Compute where rays met solids of movers.

        Args:
            starts, rays, times_s: As for `nearest`.
            ranges, solid: Its results.

        Returns:
            Points (P, n, 3), metres, and outward unit normals (P, n, 3), in the world; NaN where no
            mover was met.
        """
        points, normals = np.full((2, *rays.shape), np.nan)
        _surfaces(
            starts,
            rays,
            times_s,
            self._courses,
            (self.owner, self.shape, self.size, self.offset),
            ranges,
            solid,
            points,
            normals,
        )
        return points, normals

    def _balls_while(self, begin_s: float, end_s: float) -> Floats:
        """Centre and squared radius (M, 4), metres, of balls that hold all movers from one time to
        another."""
        balls = np.column_stack([self.poses((begin_s + end_s) / 2)[0], self._radius])
        if end_s > begin_s:
            repeats = math.isfinite(self.period_s)
            fastest = self._fastest_in_period if repeats else self._fastest_until(end_s)
            balls[:, 3] += fastest * (end_s - begin_s) / 2
        # rounding must not leave out a solid that is touched
        balls[:, 3] = (balls[:, 3] * (1.0 + 1e-6)) ** 2
        return balls

    @cached_property
    def _courses(self) -> tuple[float, Ints, Floats, Floats]:
        """The arguments of kernels that find poses."""
        return float(self.period_s), self.piece_start, self.begin_s, self.course

    @cached_property
    def _fastest_in_period(self) -> Floats:
        return self._fastest_until(self.period_s)

    def _fastest_until(self, end_s: float) -> Floats:
        """Greatest speed (M,) of each mover's origin up to a time, metres a second."""
        lengths = np.diff(np.append(self.begin_s, 0.0))
        # the last piece of each mover ends then
        last = self.piece_start[1:] - 1
        lengths[last] = np.maximum(end_s - self.begin_s[last], 0.0)
        # places have no cubic term, so speeds are greatest at an end of a piece
        slopes = self.course[:, :3, 1] + np.multiply.outer(
            (0.0, 2.0), lengths[:, None] * self.course[:, :3, 2]
        )
        speeds = np.sqrt((slopes * slopes).sum(axis=2)).max(axis=0)
        first = self.piece_start[:-1]
        return np.maximum.reduceat(speeds, first) if len(first) else np.empty(0)

    @property
    def bodies(self) -> tuple[Any, ...]:
        """The arguments of kernels that measure distances: courses, radii of balls about the
        origins, and the solids with their starts."""
        return self._courses, self._radius, self.solid_start, self.shape, self.size, self.offset

    @cached_property
    def _radius(self) -> Floats:
        """Radius (M,), metres, of a ball about each mover's origin that holds its solids."""
        reach = np.sqrt(squared_reaches(self.shape, self.size))
        reach += np.sqrt((self.offset * self.offset).sum(axis=1))
        radius = np.zeros(len(self))
        np.maximum.at(radius, self.owner, reach)
        return radius

    @cached_property
    def boxes(self) -> tuple[Floats, Floats]:
        """The box around each mover in its frame: least and greatest corners (M, 3), metres."""
        upright = np.broadcast_to(np.eye(3), (len(self.owner), 3, 3))
        low, high = bounding_boxes(self.shape, self.size, self.offset, upright)
        lower, upper = np.full((len(self), 3), np.inf), np.full((len(self), 3), -np.inf)
        np.minimum.at(lower, self.owner, low)
        np.maximum.at(upper, self.owner, high)
        return lower, upper

    @cached_property
    def solid_start(self) -> Ints:
        """(M + 1,): mover m has the solids solid_start[m] to solid_start[m + 1]."""
        return np.searchsorted(self.owner, np.arange(len(self) + 1))

    def add_to(self, spec: "mujoco.MjSpec", time_s: float) -> None:
        """Add the movers to an MJCF document as mocap bodies, where they are at a time.

        Args:
            spec: The document.
            time_s: The time, seconds.
        """
        position, heading, _, _ = self.poses(time_s)
        for m in range(len(self)):
            x, y = heading[m]
            # the half angle of the heading, without trigonometry
            half = (
                np.array([1.0 + x, y]) if x > -0.5 else np.array([abs(y), math.copysign(1 - x, y)])
            )
            half /= math.sqrt(half @ half)
            body = spec.worldbody.add_body(
                name=f"mover_{m}", mocap=True, pos=position[m], quat=[half[0], 0.0, 0.0, half[1]]
            )
            for solid in np.flatnonzero(self.owner == m):
                body.add_geom(
                    type=int(self.shape[solid]), size=self.size[solid], pos=self.offset[solid]
                )


class MovingCaster:
    """A caster of a world whose movers are where they are at a time: an `Engine` without `of`.

    Geoms of `hits` are numbered on from those of the standing world: `geoms` + the solid's number
    among all movers' solids."""

    def __init__(self, standing: Caster, movers: Movers, time_s: ArrayLike, *, geoms: int = 0):
        """Fix the time.

        Args:
            standing: Casts rays in the world without movers.
            movers: What moves in it.
            time_s: Seconds; one number, or one for each ray of a pose, (*shape).
            geoms: How many geoms the standing world has.
        """
        self._standing, self._movers, self._geoms = standing, movers, geoms
        self._time_s = np.asarray(time_s, float)

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """See `lidarsim.engines.Caster.cast`.

        Returns:
            (P, *shape), metres.

        Raises:
            ValueError: If times were given for other rays.
        """
        ranges = self._standing.cast(origins, directions, max_range_m)
        return self._meet(origins, directions, max_range_m, ranges)[0]

    def of_rays(self, rays: Any) -> "MovingCaster":
        """Return the caster for some rays of a pose.

        Args:
            rays: An index of arrays (*shape).
        """
        times = self._time_s[rays] if self._time_s.ndim else self._time_s
        return MovingCaster(self._standing, self._movers, times, geoms=self._geoms)

    @property
    def hits(self) -> Callable[..., Hits]:
        """The method `hits` of the world with movers, see `AnalyticEngine.hits`.

        Raises:
            AttributeError: If the caster of the standing world has none.
        """
        return partial(self._hits, self._standing.hits)  # type: ignore[attr-defined]

    def _hits(
        self,
        hits_standing: Callable[..., Hits],
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        *,
        through: ArrayLike | None = None,
    ) -> Hits:
        standing = hits_standing(origins, directions, max_range_m, through=through)
        ranges, solid, query = self._meet(origins, directions, max_range_m, standing.ranges)
        flat = query[1].shape[:2]
        surfaces = self._movers.surfaces(*query, ranges.reshape(flat), solid.reshape(flat))
        moving = solid >= 0
        points, normals = (
            np.where(moving[..., None], values.reshape(standing.points.shape), others)
            for values, others in zip(surfaces, (standing.points, standing.normals), strict=True)
        )
        geoms = np.where(moving, self._geoms + solid, standing.geoms)
        return Hits(ranges, geoms, points, normals)

    def solid_of(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Ints:
        """Tell which of the movers' solids each ray meets first.

        Args:
            origins: As for `cast`.
            directions: As for `cast`.
            max_range_m: As for `cast`.

        Returns:
            (P, *shape): the solid's number, -1 where the ray meets none, or something nearer.
        """
        starts, rays = np.asarray(origins, float), np.asarray(directions, float)
        unlimited = np.full(rays.shape[:-1], max_range_m)
        ranges, solid, _ = self._meet(starts, rays, max_range_m, unlimited)
        # few rays meet movers: only these can be stopped before
        for pose in np.flatnonzero((solid >= 0).reshape(len(solid), -1).any(axis=1)):
            hit = np.nonzero(solid[pose] >= 0)
            before = self._standing.cast(starts[[pose]], rays[pose][hit][None], max_range_m)[0]
            solid[pose][hit] = np.where(before <= ranges[pose][hit], -1, solid[pose][hit])
        return solid

    def _meet(
        self, origins: ArrayLike, directions: ArrayLike, max_range_m: float, ranges: Floats
    ) -> tuple[Floats, Ints, tuple[Floats, Floats, Floats]]:
        """Return ranges (P, *shape), solids (P, *shape), and starts, rays (P, n, 3) and times."""
        starts, rays = rays_of(origins, directions, max_range_m)
        poses, *shape = rays.shape[:-1]
        times = self._time_s
        if times.ndim and list(times.shape) != shape:
            raise ValueError(f"times of shape {times.shape} for rays {tuple(shape)}; give one each")
        flat = rays.reshape(poses, math.prod(shape), 3)
        # a surface of the standing world at the same distance is met first, as in one engine
        limit = np.minimum(ranges, np.nextafter(max_range_m, np.inf)).reshape(flat.shape[:2])
        query = starts, flat, times.reshape(-1)
        nearer, solid = self._movers.nearest(*query, limit)
        result = np.where(solid >= 0, nearer, ranges.reshape(limit.shape))
        return result.reshape(ranges.shape), solid.reshape(ranges.shape), query


@kernel
def _piece(first, last, begin_s, time):
    """The last piece of `first` to `last` that begins by a time; the first if none does."""
    low, high = first, last
    while high - low > 1:
        middle = (low + high) // 2
        if begin_s[middle] <= time:
            low = middle
        else:
            high = middle
    return low


@kernel
def _value(course, piece, channel, u):
    """A polynomial, by Horner's rule."""
    c = course[piece, channel]
    return c[0] + u * (c[1] + u * (c[2] + u * c[3]))


@kernel
def _slope(course, piece, channel, u):
    """Its derivative."""
    c = course[piece, channel]
    return c[1] + u * (2.0 * c[2] + u * (3.0 * c[3]))


@kernel
def pose(course, piece, u):
    """Compute a mover's pose in a piece of its course.

    Args:
        course: Of `Movers`.
        piece: The piece's number.
        u: Seconds since it began.

    Returns:
        x, y, z, metres, and the heading's x and y, a unit vector.
    """
    hx, hy = _value(course, piece, 3, u), _value(course, piece, 4, u)
    length = math.sqrt(hx * hx + hy * hy)
    return (
        _value(course, piece, 0, u),
        _value(course, piece, 1, u),
        _value(course, piece, 2, u),
        hx / length,
        hy / length,
    )


@kernel
def location(course, piece, u):
    """Compute a mover's place in a piece of its course, x, y, z in metres.

    Args:
        course, piece, u: As for `pose`.
    """
    return _value(course, piece, 0, u), _value(course, piece, 1, u), _value(course, piece, 2, u)


@kernel
def velocity(course, piece, u):
    """Compute a mover's velocity in a piece of its course, x, y, z in metres a second.

    Args:
        course, piece, u: As for `pose`.
    """
    return _slope(course, piece, 0, u), _slope(course, piece, 1, u), _slope(course, piece, 2, u)


@kernel
def find_piece(m, time, courses):
    """Find the piece of mover `m` at a time, the seconds since that piece began, and the mover's
    place.

    Args:
        m: The mover's number.
        time: Seconds.
        courses: Period, starts of movers' pieces, begins of pieces, and pieces, as in `Movers`.

    Returns:
        The piece, seconds, and x, y, z, metres.
    """
    period, piece_start, begin_s, course = courses
    if period < math.inf:
        # exact, as periods are powers of two
        time -= math.floor(time / period) * period
    piece = _piece(piece_start[m], piece_start[m + 1], begin_s, time)
    u = time - begin_s[piece]
    return (
        piece,
        u,
        _value(course, piece, 0, u),
        _value(course, piece, 1, u),
        _value(course, piece, 2, u),
    )


@kernel
def _poses(time, courses, result):
    course = courses[3]
    for m in range(len(result)):
        piece, u, x, y, z = find_piece(m, time, courses)
        hx, hy = _value(course, piece, 3, u), _value(course, piece, 4, u)
        dx, dy = _slope(course, piece, 3, u), _slope(course, piece, 4, u)
        square = hx * hx + hy * hy
        length = math.sqrt(square)
        result[m, 0], result[m, 1], result[m, 2] = x, y, z
        result[m, 3], result[m, 4] = hx / length, hy / length
        for axis in range(3):
            result[m, 5 + axis] = _slope(course, piece, axis, u)
        result[m, 8] = (hx * dy - hy * dx) / square


@kernel
def _nearest(
    starts,
    rays,
    times,
    courses,
    bodies,
    balls,
    ranges,
    solids,
):
    solid_start, shape, size, offset = bodies
    course = courses[3]
    for p in range(len(starts)):
        reach = 0.0
        for n in range(ranges.shape[1]):
            reach = max(reach, ranges[p, n])
        for m in range(len(balls)):
            sx, sy, sz = joining(balls[m], starts[p])
            apart2, radius2 = sx * sx + sy * sy + sz * sz, balls[m, 3]
            if math.sqrt(apart2) - math.sqrt(radius2) > reach:
                continue
            # the test of `passes`, whose constants are the same for all rays
            surplus, outside = apart2 * FARTHER - radius2, apart2 > radius2
            for n in range(ranges.shape[1]):
                dx, dy, dz = rays[p, n, 0], rays[p, n, 1], rays[p, n, 2]
                along = sx * dx + sy * dy + sz * dz
                if along * along < surplus or (outside and along > 0.0):
                    continue
                time = times[n if len(times) > 1 else 0]
                piece, u, x, y, z = find_piece(m, time, courses)
                _, _, _, hx, hy = pose(course, piece, u)
                ux, uy, uz = starts[p, 0] - x, starts[p, 1] - y, starts[p, 2] - z
                # to the mover's frame: the transpose of a turn about the vertical
                px, py = hx * ux + hy * uy, hx * uy - hy * ux
                qx, qy = hx * dx + hy * dy, hx * dy - hy * dx
                for s in range(solid_start[m], solid_start[m + 1]):
                    ox, oy, oz = px - offset[s, 0], py - offset[s, 1], uz - offset[s, 2]
                    t = meet(shape[s], size[s, 0], size[s, 1], size[s, 2], ox, oy, oz, qx, qy, dz)
                    if t < ranges[p, n]:
                        ranges[p, n], solids[p, n] = t, s


@kernel
def _surfaces(
    starts,
    rays,
    times,
    courses,
    bodies,
    ranges,
    solids,
    points,
    normals,
):
    owner, shape, size, offset = bodies
    course = courses[3]
    for p in range(len(starts)):
        for n in range(ranges.shape[1]):
            s = solids[p, n]
            if s < 0:
                continue
            for axis in range(3):
                points[p, n, axis] = starts[p, axis] + ranges[p, n] * rays[p, n, axis]
            time = times[n if len(times) > 1 else 0]
            piece, u, x, y, z = find_piece(owner[s], time, courses)
            _, _, _, hx, hy = pose(course, piece, u)
            sx, sy, sz = points[p, n, 0] - x, points[p, n, 1] - y, points[p, n, 2] - z
            px, py = hx * sx + hy * sy - offset[s, 0], hx * sy - hy * sx - offset[s, 1]
            pz = sz - offset[s, 2]
            x, y, z = surface_normal(shape[s], size[s, 0], size[s, 1], size[s, 2], px, py, pz)
            normals[p, n, 0], normals[p, n, 1] = hx * x - hy * y, hy * x + hx * y
            normals[p, n, 2] = z
