"""Scans become two grids: the voxels that hold returns, and the voxels that rays crossed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.elementary import log
from lidarsim.engines.voxels import enter, slab
from lidarsim.fusion import Fusion
from lidarsim.grid import Floats, GridSpec, Mask, finite
from lidarsim.jit import kernel
from lidarsim.parameters import shown
from lidarsim.scan import Scan

TOUCH_M = 1e-9
"""A ray meets a voxel with positive length when that length exceeds this: rounding at edges and
corners is less."""


@dataclass(frozen=True, eq=False)
class ObservedGrid:
    """What one scan, or several, tell about a grid. A voxel neither free nor observed is
    unknown."""

    observed: Mask
    """(*shape): holds at least one return."""
    free: Mask
    """(*shape): not observed, and some ray's segment, from the sensor to its return or to the
    sensor's range, meets it with positive length."""
    origin: Floats
    """(3,): the grid's least corner in the world, metres."""


def unknown_grid(grid: GridSpec, origin: Floats) -> ObservedGrid:
    """A grid of which nothing is known yet."""
    observed, free = np.zeros((2, *grid.shape), bool)
    return ObservedGrid(observed, free, origin)


def voxelize(scan: Scan, grid: GridSpec, origin: ArrayLike | None = None) -> ObservedGrid:
    """Sort a scan into `grid`, centred on the sensor unless its least corner `origin` (3,) is
    given.

    Returns outside the grid are dropped; the rays that led to them still clear the voxels on their
    way. Free space is found by walking every ray from voxel boundary to voxel boundary (Amanatides
    and Woo 1987), not by sampling. Raises ValueError for a `scan` that is none, and for an `origin`
    that is no point.
    """
    if not isinstance(scan, Scan):
        raise ValueError(f"scan = {shown(scan)}: expected a Scan, such as lidarsim.cast gives")
    position = scan.pose.position
    corner = finite("origin", grid.origin_at(position) if origin is None else origin, 3)
    directions = scan.directions.reshape(-1, 3)
    found = unknown_grid(grid, corner)
    _walk(
        position,
        directions,
        scan.ranges.reshape(-1),
        scan.lidar.max_range_m,
        corner,
        grid.voxel_m,
        found.observed,
        found.free,
    )
    return found


def fuse(
    scans: Sequence[Scan], grid: GridSpec, origin: ArrayLike, fusion: Fusion | None = None
) -> ObservedGrid:
    """Sort several scans, in the order in which they were made, into the `grid` with least corner
    `origin` (3,).

    By visibility, the order says nothing: a voxel is observed where any scan has a return in it,
    and free where none has and some ray of any crosses it. By log-odds, see `Fusion`, each scan
    raises those of the voxels that it observes and lowers those that it finds free, within bounds;
    a voxel that no scan met stays unknown. Only a voxel with a return can be observed, whatever the
    parameters, because `Fusion.occupied` is at least one half. Raises ValueError where there is no
    scan, and for an `origin` that is no point.
    """
    if not scans:
        raise ValueError("no scans to fuse; expected one at least")
    seen = [voxelize(scan, grid, origin) for scan in scans]
    rule = fusion or Fusion()
    if rule.fusion == "visibility":
        found, *others = seen
        for one in others:
            found.observed[one.observed] = True
            found.free[one.free] = True
        found.free[found.observed] = False
        return found
    given = np.array([rule.hit, rule.miss, rule.least, rule.most, rule.occupied])
    hit, miss, least, most, occupied = (log(given) - log(1.0 - given)).tolist()
    odds, met = np.zeros(grid.shape), np.zeros(grid.shape, bool)
    for one in seen:
        _weigh(
            one.observed.reshape(-1), one.free.reshape(-1), odds.reshape(-1), hit, miss, least, most
        )
        met |= one.observed | one.free
    observed = met & (odds >= occupied)
    return ObservedGrid(observed, met & ~observed, seen[0].origin)


@kernel
def _weigh(observed, free, odds, hit, miss, least, most):
    """Add to log-odds what one scan says of each voxel."""
    for n in range(len(odds)):
        if observed[n]:
            odds[n] = min(odds[n] + hit, most)
        elif free[n]:
            odds[n] = max(odds[n] + miss, least)


def sort_points(
    sensor: Floats,
    points: Floats,
    grid: GridSpec,
    origin: Floats,
    *,
    reach_m: float = math.inf,
    into: ObservedGrid | None = None,
) -> ObservedGrid:
    """Sort rays known by their returns alone, as `voxelize` does: from `sensor` (3,) to `points`
    (N, 3), finite, in the frame of `origin`, metres. Those beyond `reach_m` clear the voxels up to
    it and mark none; a point at the sensor clears nothing. With `into`, what that grid's arrays say
    already stays, but that a voxel with a return is not free."""
    rays = np.asarray(points, float) - sensor
    ranges = np.sqrt((rays * rays).sum(axis=1))
    found = into or unknown_grid(grid, origin)
    there = ranges > 0
    directions = rays[there] / ranges[there, None]
    _walk(
        np.asarray(sensor, float),
        directions,
        np.where(ranges > reach_m, np.inf, ranges)[there],
        reach_m,
        origin,
        grid.voxel_m,
        found.observed,
        found.free,
    )
    return found


@kernel
def _walk(position, directions, ranges, max_range_m, origin, voxel_m, observed, free):
    """Mark `free` along every ray and `observed` at its end."""
    nx, ny, nz = observed.shape
    observed, free = observed.reshape(-1), free.reshape(-1)
    for ray in range(len(ranges)):
        end = float(ranges[ray]) if math.isfinite(ranges[ray]) else max_range_m
        clear(position, directions[ray], end, origin, voxel_m, nx, ny, nz, free)
    for ray in range(len(ranges)):
        if math.isfinite(ranges[ray]):
            reach = float(ranges[ray])
            cell = cell_at(position, directions[ray], reach, origin, voxel_m, nx, ny, nz)
            if cell >= 0:
                observed[cell] = True
                free[cell] = False


@kernel
def cell_at(position, direction, reach, origin, voxel_m, nx, ny, nz):
    """Number of the voxel that holds the point `reach` metres along a ray; -1 outside the grid."""
    x = float(math.floor((position[0] + reach * direction[0] - origin[0]) / voxel_m))
    y = float(math.floor((position[1] + reach * direction[1] - origin[1]) / voxel_m))
    z = float(math.floor((position[2] + reach * direction[2] - origin[2]) / voxel_m))
    if 0.0 <= x < float(nx) and 0.0 <= y < float(ny) and 0.0 <= z < float(nz):
        return (int(x) * ny + int(y)) * nz + int(z)
    return -1


@kernel
def clear(position, direction, end, origin, voxel_m, nx, ny, nz, free):
    """Mark the voxels, of nx * ny * nz one after the other, that the segment of length `end` from
    `position` along `direction` meets.

    Every crossing is computed from its boundary's own number, never by adding up steps, so that
    errors do not grow.
    """
    sx, px, in_x, out_x = slab(position[0], origin[0], direction[0], nx, voxel_m)
    sy, py, in_y, out_y = slab(position[1], origin[1], direction[1], ny, voxel_m)
    sz, pz, in_z, out_z = slab(position[2], origin[2], direction[2], nz, voxel_m)
    t = max(max(in_x, in_y), max(in_z, 0.0))
    leave = min(min(out_x, out_y), min(out_z, end))
    if not leave - t > TOUCH_M:
        return
    i, ux, bx, tx = enter(sx, t, px, nx)
    j, uy, by, ty = enter(sy, t, py, ny)
    k, uz, bz, tz = enter(sz, t, pz, nz)
    dx, dy, dz = int(ux) * ny * nz, int(uy) * nz, int(uz)
    cell = (i * ny + j) * nz + k
    while True:
        if tx < ty:
            if tx < tz:
                at, move = tx, dx
                bx += ux
                tx = (bx - sx) * px
            else:
                at, move = tz, dz
                bz += uz
                tz = (bz - sz) * pz
        elif ty < tz:
            at, move = ty, dy
            by += uy
            ty = (by - sy) * py
        else:
            at, move = tz, dz
            bz += uz
            tz = (bz - sz) * pz
        if at >= leave:
            if leave - t > TOUCH_M:
                free[cell] = True
            return
        if at - t > TOUCH_M:
            free[cell] = True
            t = at
        cell += move
