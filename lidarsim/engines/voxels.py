"""Rays through a map of voxels, each occupied, free or unknown: what a robot's mapping keeps of a
real place."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import Floats, rays_of
from lidarsim.jit import kernel

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
"""States of a voxel."""
LEAST_CHORD_M = 1e-4
"""A ray meets an occupied voxel when it runs this far in it: the middle of that way lies in the
voxel also when the range is rounded to float32, up to a kilometre."""


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """What is known of a place. What lies beyond the map is unknown."""

    states: NDArray[np.uint8]
    """(nx, ny, nz): `UNKNOWN`, `FREE` or `OCCUPIED`; x y z in that order, z up."""
    voxel_m: float
    """Edge of a voxel, metres."""
    origin: Floats
    """(3,): the map's least corner in the world, metres."""

    @property
    def bounds(self) -> Floats:
        """(2, 3): the map's least and greatest corner in the world, metres."""
        extent = np.array(self.states.shape, float) * self.voxel_m
        return np.stack([self.origin, self.origin + extent])


class VoxelEngine:
    """Casts rays through a `VoxelMap` from voxel to voxel (Amanatides and Woo 1987).

    A map does not say where in a voxel the surface lies. A ray that meets an occupied voxel returns
    from the middle of its way through it, so that a return lies in that voxel. Rays pass through
    unknown voxels; `cross` tells how far.
    """

    def __init__(self, voxels: VoxelMap):
        self.voxels = voxels
        self._last: tuple[Floats, ...] = ()

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """See `lidarsim.engines.Engine.cast`, but for the rays from within a solid: they meet the
        voxel in which they begin."""
        return self.cross(origins, directions, max_range_m)[0]

    def cross(
        self, origins: ArrayLike, directions: ArrayLike, max_range_m: float
    ) -> tuple[Floats, Floats]:
        """Ranges as `cast` gives them, and the metres of unknown space that each ray crosses before
        it returns, or within `max_range_m`; both (P, *shape). Who asks after `cast` for the same
        rays pays nothing: one walk gives both."""
        self.mostly_known(origins, directions, max_range_m)
        return self._last[-2].copy(), self._last[-1].copy()

    def mostly_known(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        most_unknown_m: float = math.inf,
        most_share: float = 1.0,
    ) -> bool:
        """Whether a share of the rays of `most_share` at most crosses more metres of unknown space
        than `most_unknown_m`. It walks no farther than it must to say no; after a yes, `cross` has
        nothing to do."""
        starts, rays = rays_of(origins, directions, max_range_m)
        shape, asked = rays.shape[:-1], (starts, rays, np.array(max_range_m))
        if not (self._last and all(map(np.array_equal, self._last, asked))):
            ranges, unknown = np.full(shape, np.inf), np.empty(shape)
            count = int(np.prod(shape[1:]))
            if not _cast(
                starts,
                rays.reshape(len(starts), count, 3),
                float(max_range_m),
                np.ascontiguousarray(self.voxels.states),
                self.voxels.voxel_m,
                self.voxels.origin,
                ranges.reshape(len(starts), count),
                unknown.reshape(len(starts), count),
                float(most_unknown_m),
                float(most_share),
                shape[-1],
            ):
                return False
            self._last = *asked, ranges, unknown
        return bool((self._last[-1] > most_unknown_m).mean() <= most_share)


@kernel
def _cast(
    origins,
    directions,
    max_range_m,
    states,
    voxel_m,
    origin,
    ranges,
    unknown,
    most_unknown_m,
    most_share,
    columns,
):
    """Fill ranges (P, n) and metres of unknown space (P, n) for directions (P, n, 3), unless more
    than `most_share` of the rays cross more than `most_unknown_m`: False. Rays that do so are
    walked to their ends only when that is decided, in the third sweep. In the first, from the last
    row of `columns` rays on, which looks up, are those above which one does so: most do, too."""
    marked, unknown[:] = 0, -1.0
    for sweep in range(3):
        limit = math.inf if sweep == 2 else most_unknown_m
        for p in range(len(origins)):
            if not abs(origins[p, 0]) + abs(origins[p, 1]) + abs(origins[p, 2]) < math.inf:
                unknown[p] = 0.0
                continue
            for n in range(directions.shape[1] - 1, -1, -1):
                above = n if sweep == 2 else n + columns
                if sweep == 1:
                    left_out = unknown[p, n] >= 0.0
                else:
                    left_out = above < len(unknown[p]) and not unknown[p, above] > most_unknown_m
                if left_out:
                    continue
                unknown[p, n] = 0.0
                x, y, z = directions[p, n]
                length2 = x * x + y * y + z * z
                if abs(length2 - 1.0) <= 2e-6:  # as `Engine.cast` has it; not where it is NaN
                    length = math.sqrt(length2)
                    ranges[p, n], unknown[p, n] = _first(
                        origins[p],
                        (x / length, y / length, z / length),
                        max_range_m,
                        states,
                        voxel_m,
                        origin,
                        limit,
                    )
                if unknown[p, n] > limit:
                    marked += 1
                    if marked / ranges.size > most_share:
                        return False
    return True


@kernel
def _first(position, direction, max_range_m, states, voxel_m, origin, most_unknown_m):
    """The range of one ray, and the metres of unknown space on its way; only that these are more
    than `most_unknown_m`, where they are."""
    nx, ny, nz = states.shape
    sx, px, in_x, out_x = slab(position[0], origin[0], direction[0], nx, voxel_m)
    sy, py, in_y, out_y = slab(position[1], origin[1], direction[1], ny, voxel_m)
    sz, pz, in_z, out_z = slab(position[2], origin[2], direction[2], nz, voxel_m)
    t = max(max(in_x, in_y), max(in_z, 0.0))
    leave = min(min(out_x, out_y), out_z)
    if not leave > t or t >= max_range_m:
        return math.inf, max_range_m
    unknown = t
    i, ux, bx, tx = enter(sx, t, px, nx)
    j, uy, by, ty = enter(sy, t, py, ny)
    k, uz, bz, tz = enter(sz, t, pz, nz)
    dx, dy, dz = int(ux) * ny * nz, int(uy) * nz, int(uz)
    cells, cell = states.reshape(-1), (i * ny + j) * nz + k
    while True:
        # each crossing is computed from its boundary's own number: errors do not add up
        state, at = cells[np.uint64(cell)], min(leave, min(tx, min(ty, tz)))
        if state != FREE and at > t:
            if state == UNKNOWN:
                unknown += min(at, max_range_m) - t
                if unknown > most_unknown_m:
                    break
            elif at - t >= LEAST_CHORD_M:
                middle = t + 0.5 * (at - t)
                return (middle if middle <= max_range_m else math.inf), unknown
        t = max(t, at)
        if at >= leave or t >= max_range_m:
            break
        if tx == at:
            cell += dx
            bx += ux
            tx = (bx - sx) * px
        elif ty == at:
            cell += dy
            by += uy
            ty = (by - sy) * py
        else:
            cell += dz
            bz += uz
            tz = (bz - sz) * pz
    return math.inf, unknown + max(max_range_m - max(t, 0.0), 0.0)


STILL = 1e-300
"""A ray whose direction has less than this along an axis stands still there: a voxel would take it
an infinite way, and infinity times no way at all is NaN."""


@kernel
def slab(position, origin, direction, count, voxel_m):
    """Along one axis: where a ray starts, counted in voxels from a grid's origin; metres of ray per
    voxel (0 for a ray that stands still there); and where it enters and leaves the grid."""
    start = (position - origin) / voxel_m
    if abs(direction) < STILL:
        inside = 0.0 <= start < float(count)
        return start, 0.0, -math.inf if inside else math.inf, math.inf if inside else -math.inf
    pace = voxel_m / direction
    first, last = (0.0 - start) * pace, (float(count) - start) * pace
    return start, pace, min(first, last), max(first, last)


@kernel
def enter(start, t, pace, count):
    """The voxel's number along one axis at distance `t`, in which sense it changes, the boundary
    ahead of it, and where the ray crosses that."""
    if pace == 0.0:
        return math.floor(start), 0.0, 0.0, math.inf
    at = min(max(math.floor(start + t / pace), 0), count - 1)
    if pace > 0.0:
        return at, 1.0, float(at + 1), (float(at + 1) - start) * pace
    return at, -1.0, float(at), (float(at) - start) * pace
