"""Voxelization: scans become the voxels that hold returns, and the voxels that rays crossed."""

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
from lidarsim.parameters import short_repr
from lidarsim.scan import Scan

TOUCH_M = 1e-9
"""A ray meets a voxel with positive length when that length exceeds this: rounding at edges and
corners is less."""


@dataclass(frozen=True, eq=False)
class ObservedGrid:
    """The state of a grid after scans. A voxel that is neither free nor observed is unknown."""

    observed: Mask
    """(*shape): holds at least one return."""
    free: Mask
    """(*shape): not observed, and some ray's segment, from the sensor to its return or to the
    sensor's range, meets it with positive length."""
    origin: Floats
    """(3,): the grid's least corner in the world, metres."""


def unknown_grid(grid: GridSpec, origin: Floats) -> ObservedGrid:
    """Make a grid in which every voxel is unknown.

    Args:
        grid: Its shape and voxels.
        origin: (3,): its least corner in the world, metres.

    Returns:
        The grid; its arrays may be written to.
    """
    observed, free = np.zeros((2, *grid.shape), bool)
    return ObservedGrid(observed, free, origin)


def voxelize(scan: Scan, grid: GridSpec, origin: ArrayLike | None = None) -> ObservedGrid:
    """Sort a scan into a grid.

    Returns outside the grid are dropped, but their rays still clear the voxels on their way. Free
    space is found by walking every ray from voxel boundary to voxel boundary (Amanatides and Woo
    1987), not by sampling.

    Args:
        scan: The scan.
        grid: Shape and voxels of the grid.
        origin: (3,): the grid's least corner in the world, metres; None centres it on the sensor.

    Returns:
        Observed and free voxels.

    Raises:
        ValueError: If `scan` is not a Scan, or `origin` is not three finite numbers.
    """
    if not isinstance(scan, Scan):
        raise ValueError(f"scan = {short_repr(scan)}: expected a Scan, such as lidarsim.cast gives")
    position = scan.pose.position
    corner = finite("origin", grid.origin_at(position) if origin is None else origin, 3)
    directions = scan.directions.reshape(-1, 3)
    marked = unknown_grid(grid, corner)
    _walk(
        position,
        directions,
        scan.ranges.reshape(-1),
        scan.lidar.max_range_m,
        corner,
        grid.voxel_m,
        marked.observed,
        marked.free,
    )
    return marked


def fuse(
    scans: Sequence[Scan], grid: GridSpec, origin: ArrayLike, fusion: Fusion | None = None
) -> ObservedGrid:
    """Sort several scans into one grid.

    By visibility, the order does not matter: a voxel is observed if any scan has a return in it,
    and free if none has and a ray of any scan crosses it. By log-odds, see `Fusion`, each scan
    raises those of the voxels that it observes and lowers those that it finds free, within bounds;
    a voxel that no scan met stays unknown. Only a voxel with a return can be observed, whatever the
    parameters, because `Fusion.occupied` is at least one half.

    Args:
        scans: One or more, in the order in which they were made.
        grid: Shape and voxels of the grid.
        origin: (3,): the grid's least corner in the world, metres.
        fusion: The rule; by visibility if None.

    Returns:
        Observed and free voxels.

    Raises:
        ValueError: If there is no scan, or `origin` is not three finite numbers.
    """
    if not scans:
        raise ValueError("no scans to fuse; expected one at least")
    seen = [voxelize(scan, grid, origin) for scan in scans]
    rule = fusion or Fusion()
    if rule.fusion == "visibility":
        union, *later = seen
        for part in later:
            union.observed[part.observed] = True
            union.free[part.free] = True
        # last: one scan's return outweighs another's crossing
        union.free[union.observed] = False
        return union
    probabilities = np.array([rule.hit, rule.miss, rule.least, rule.most, rule.occupied])
    hit, miss, lower, upper, occupied = (log(probabilities) - log(1.0 - probabilities)).tolist()
    odds, met = np.zeros(grid.shape), np.zeros(grid.shape, bool)
    for part in seen:
        arrays = part.observed.reshape(-1), part.free.reshape(-1), odds.reshape(-1)
        _weigh(*arrays, hit, miss, lower, upper)
        met |= part.observed | part.free
    observed = met & (odds >= occupied)
    return ObservedGrid(observed, met & ~observed, seen[0].origin)


@kernel
def _weigh(observed, free, odds, hit, miss, lower, upper):
    """Add one scan's evidence to log-odds, clamped to [lower, upper]."""
    for n in range(len(odds)):
        if observed[n]:
            odds[n] = min(odds[n] + hit, upper)
        elif free[n]:
            odds[n] = max(odds[n] + miss, lower)


def sort_points(
    sensor: Floats,
    points: Floats,
    grid: GridSpec,
    origin: Floats,
    *,
    reach_m: float = math.inf,
    into: ObservedGrid | None = None,
) -> ObservedGrid:
    """Sort rays known only by their returns, as `voxelize` does.

    Args:
        sensor: (3,), in the frame of `origin`, metres.
        points: (N, 3), finite, in that frame, metres. A point at the sensor clears nothing.
        grid: Shape and voxels of the grid.
        origin: (3,): its least corner, metres.
        reach_m: Points farther away clear the voxels up to here, and mark none.
        into: A grid to add to, in place. Its marks stay, but voxels with a new return are not free.

    Returns:
        `into`, or a new grid.
    """
    rays = np.asarray(points, float) - sensor
    ranges = np.sqrt((rays * rays).sum(axis=1))
    marked = into or unknown_grid(grid, origin)
    distant = ranges > 0
    directions = rays[distant] / ranges[distant, None]
    _walk(
        np.asarray(sensor, float),
        directions,
        np.where(ranges > reach_m, np.inf, ranges)[distant],
        reach_m,
        origin,
        grid.voxel_m,
        marked.observed,
        marked.free,
    )
    return marked


@kernel
def _walk(position, directions, ranges, max_range_m, origin, voxel_m, observed, free):
    """Mark `free` along every ray, then `observed` at its end."""
    nx, ny, nz = observed.shape
    observed, free = observed.reshape(-1), free.reshape(-1)
    for ray in range(len(ranges)):
        end = float(ranges[ray]) if math.isfinite(ranges[ray]) else max_range_m
        clear(position, directions[ray], end, origin, voxel_m, nx, ny, nz, free)
    # after all rays are walked: no later ray may clear a voxel with a return
    for ray in range(len(ranges)):
        if math.isfinite(ranges[ray]):
            reach = float(ranges[ray])
            cell = cell_at(position, directions[ray], reach, origin, voxel_m, nx, ny, nz)
            if cell >= 0:
                observed[cell] = True
                free[cell] = False


@kernel
def cell_at(position, direction, reach, origin, voxel_m, nx, ny, nz):
    """Find the voxel that holds a point of a ray.

    Args:
        position: (3,): the ray's origin, metres.
        direction: (3,), of length 1.
        reach: The point's distance from the origin, metres.
        origin: (3,): the grid's least corner, metres.
        voxel_m: Edge of a voxel, metres.
        nx, ny, nz: The grid's shape.

    Returns:
        The voxel's number in C order; -1 outside the grid.
    """
    # compared as floats: a far point would overflow an integer
    x = float(math.floor((position[0] + reach * direction[0] - origin[0]) / voxel_m))
    y = float(math.floor((position[1] + reach * direction[1] - origin[1]) / voxel_m))
    z = float(math.floor((position[2] + reach * direction[2] - origin[2]) / voxel_m))
    if 0.0 <= x < float(nx) and 0.0 <= y < float(ny) and 0.0 <= z < float(nz):
        return (int(x) * ny + int(y)) * nz + int(z)
    return -1


@kernel
def clear(position, direction, end, origin, voxel_m, nx, ny, nz, free):
    """Mark the voxels that a segment crosses.

    Args:
        position: (3,): where it begins, metres.
        direction: (3,), of length 1.
        end: Its length, metres.
        origin: (3,): the grid's least corner, metres.
        voxel_m: Edge of a voxel, metres.
        nx, ny, nz: The grid's shape.
        free: (nx * ny * nz,), C order: set to True in place.
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
    # steps of the cell's number along each axis
    dx, dy, dz = int(ux) * ny * nz, int(uy) * nz, int(uz)
    cell = (i * ny + j) * nz + k
    while True:
        # Every crossing follows from its boundary's own number, never by adding up steps, so that
        # errors do not grow. Of equal crossings one is taken at a time: the ray has no length in
        # the voxel between, which is not marked
        if tx < ty:
            if tx < tz:
                crossing, move = tx, dx
                bx += ux
                tx = (bx - sx) * px
            else:
                crossing, move = tz, dz
                bz += uz
                tz = (bz - sz) * pz
        elif ty < tz:
            crossing, move = ty, dy
            by += uy
            ty = (by - sy) * py
        else:
            crossing, move = tz, dz
            bz += uz
            tz = (bz - sz) * pz
        if crossing >= leave:
            if leave - t > TOUCH_M:
                free[cell] = True
            return
        if crossing - t > TOUCH_M:
            free[cell] = True
            t = crossing
        cell += move
