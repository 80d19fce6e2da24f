"""Ray casting through a map of occupied, free and unknown voxels, such as a robot's map of a real
place."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import Floats, rays_of
from lidarsim.jit import kernel

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
"""States of a voxel."""
MIN_CHORD_M = 1e-4
"""A ray meets an occupied voxel if it runs this far in it. The middle of that chord then lies in
the voxel also after the range is rounded to float32, up to a kilometre."""


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """A map of a place. Space beyond the map is unknown."""

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

    A map does not tell where in a voxel the surface lies. A ray that meets an occupied voxel
    returns from the middle of its chord, so that a return lies in that voxel. Rays pass through
    unknown voxels; `cross` tells how far."""

    def __init__(self, voxels: VoxelMap):
        self.voxels = voxels
        self._last: tuple[Floats, ...] = ()

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """See `lidarsim.engines.Caster.cast`; a ray that begins in an occupied voxel meets that
        voxel.

        Returns:
            (P, *shape), metres.
        """
        return self.cross(origins, directions, max_range_m)[0]

    def cross(
        self, origins: ArrayLike, directions: ArrayLike, max_range_m: float
    ) -> tuple[Floats, Floats]:
        """Cast rays, and measure the unknown space that they cross.

        The last result is cached, so `cross` after `cast` of the same rays is free.

        Args:
            origins: As for `cast`.
            directions: As for `cast`.
            max_range_m: As for `cast`.

        Returns:
            Ranges as `cast` gives them; and metres of unknown space before the return, or within
            `max_range_m`; both (P, *shape).
        """
        self.mostly_known(origins, directions, max_range_m)
        return self._last[-2].copy(), self._last[-1].copy()

    def mostly_known(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        most_unknown_m: float = math.inf,
        max_share: float = 1.0,
    ) -> bool:
        """Test whether few rays cross much unknown space.

        It walks only as far as a "no" needs; after a "yes", `cross` of the same rays is free.

        Args:
            origins: As for `cast`.
            directions: As for `cast`.
            max_range_m: As for `cast`.
            most_unknown_m: A ray that crosses more metres of unknown space than this is marked.
            max_share: The greatest share of marked rays.

        Returns:
            Whether the share of marked rays is at most `max_share`.
        """
        starts, rays = rays_of(origins, directions, max_range_m)
        shape, query = rays.shape[:-1], (starts, rays, np.array(max_range_m))
        if not (self._last and all(map(np.array_equal, self._last, query))):
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
                float(max_share),
                shape[-1],
            ):
                return False
            self._last = *query, ranges, unknown
        return bool((self._last[-1] > most_unknown_m).mean() <= max_share)


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
    max_unknown_m,
    max_share,
    columns,
):
    """Fill ranges (P, n) and metres of unknown space (P, n) for directions (P, n, 3).

    Returns False as soon as more than `max_share` of the rays cross more than `max_unknown_m`.
    Three sweeps decide that early. The first starts at the last row of `columns` rays, which looks
    up, and skips the rays below a row that is not marked. The second walks those, both only up to
    the limit. The third walks the marked rays to their ends."""
    marked, unknown[:] = 0, -1.0
    for sweep in range(3):
        limit = math.inf if sweep == 2 else max_unknown_m
        for p in range(len(origins)):
            if not abs(origins[p, 0]) + abs(origins[p, 1]) + abs(origins[p, 2]) < math.inf:
                unknown[p] = 0.0
                continue
            for n in range(directions.shape[1] - 1, -1, -1):
                above = n if sweep == 2 else n + columns
                if sweep == 1:
                    left_out = unknown[p, n] >= 0.0
                else:
                    left_out = above < len(unknown[p]) and not unknown[p, above] > max_unknown_m
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
                    if marked / ranges.size > max_share:
                        return False
    return True


@kernel
def _first(position, direction, max_range_m, states, voxel_m, origin, max_unknown_m):
    """Return one ray's range, and metres of unknown space up to it.

    If these exceed `max_unknown_m`, the walk ends there, and the range is not valid."""
    nx, ny, nz = states.shape
    sx, px, in_x, out_x = slab(position[0], origin[0], direction[0], nx, voxel_m)
    sy, py, in_y, out_y = slab(position[1], origin[1], direction[1], ny, voxel_m)
    sz, pz, in_z, out_z = slab(position[2], origin[2], direction[2], nz, voxel_m)
    t = max(max(in_x, in_y), max(in_z, 0.0))
    leave = min(min(out_x, out_y), out_z)
    if not leave > t or t >= max_range_m:
        # beside the map all is unknown
        return math.inf, max_range_m
    unknown = t
    i, ux, bx, tx = enter(sx, t, px, nx)
    j, uy, by, ty = enter(sy, t, py, ny)
    k, uz, bz, tz = enter(sz, t, pz, nz)
    dx, dy, dz = int(ux) * ny * nz, int(uy) * nz, int(uz)
    cells, cell = states.reshape(-1), (i * ny + j) * nz + k
    while True:
        # each crossing is computed from its boundary's own number: errors do not add up
        state, crossing = cells[np.uint64(cell)], min(leave, min(tx, min(ty, tz)))
        if state != FREE and crossing > t:
            if state == UNKNOWN:
                unknown += min(crossing, max_range_m) - t
                if unknown > max_unknown_m:
                    break
            elif crossing - t >= MIN_CHORD_M:
                middle = t + 0.5 * (crossing - t)
                return (middle if middle <= max_range_m else math.inf), unknown
        t = max(t, crossing)
        if crossing >= leave or t >= max_range_m:
            break
        if tx == crossing:
            cell += dx
            bx += ux
            tx = (bx - sx) * px
        elif ty == crossing:
            cell += dy
            by += uy
            ty = (by - sy) * py
        else:
            cell += dz
            bz += uz
            tz = (bz - sz) * pz
    return math.inf, unknown + max(max_range_m - max(t, 0.0), 0.0)


STILL = 1e-300
"""Below this along an axis, the ray counts as perpendicular to it. This avoids inf · 0."""


@kernel
def slab(position, origin, direction, count, voxel_m):
    """Intersect a ray with a grid along one axis.

    Args:
        position: Where the ray begins, metres.
        origin: Where the grid begins, metres.
        direction: The ray's component.
        count: Voxels of the grid.
        voxel_m: Edge of a voxel, metres.

    Returns:
        The ray's start, in voxels from the grid's origin; metres of ray per voxel, 0 if the ray is
        perpendicular to the axis; and the distances where it enters and leaves the grid, metres.
    """
    start = (position - origin) / voxel_m
    if abs(direction) < STILL:
        # the interval is all distances, or none
        inside = 0.0 <= start < float(count)
        return start, 0.0, -math.inf if inside else math.inf, math.inf if inside else -math.inf
    pace = voxel_m / direction
    first, last = (0.0 - start) * pace, (float(count) - start) * pace
    return start, pace, min(first, last), max(first, last)


@kernel
def enter(start, t, pace, count):
    """Find the voxel of a ray along one axis, and its next boundary.

    Args:
        start: The ray's start, in voxels.
        t: A distance along the ray, metres.
        pace: Metres of ray per voxel.
        count: Voxels of the grid.

    Returns:
        The voxel's number; +1, -1 or 0 by which it changes next; the boundary ahead, in voxels; and
        the distance where the ray crosses that, metres.
    """
    if pace == 0.0:
        return math.floor(start), 0.0, 0.0, math.inf
    # clamped: at the grid's face, rounding may lead outside
    cell = min(max(math.floor(start + t / pace), 0), count - 1)
    if pace > 0.0:
        return cell, 1.0, float(cell + 1), (float(cell + 1) - start) * pace
    return cell, -1.0, float(cell), (float(cell) - start) * pace
