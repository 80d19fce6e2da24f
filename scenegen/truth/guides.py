"""Ways out of a map, and how hard they are to fly: obstruction, occlusion and turning, as
FlightBench (Yu et al. 2024, arXiv 2406.05687) measures them along a guide path.

There a guide path leads from a start to a goal; here there are up to four, from the map's middle to
the nearest node of each lateral face, past no obstacle that is nearer than half a robot. Nothing is
drawn at random: a sphere of the corridor stands on the voxel around the path that is farthest from
all obstacles, where FlightBench takes the best of samples.
"""

import math
from collections.abc import Sequence

import numpy as np

from lidarsim.grid import Field, Floats, Ints, Mask, Vector
from lidarsim.jit import kernel

SENSING_M = 4.0
"""How far FlightBench's robot looks, metres."""
STEP_M = SENSING_M / 10
"""Distance between two looks along a path, metres."""
ROBOT_M = 0.15
"""What FlightBench's robot takes of every sphere, metres."""
LEAST_RADIUS_M = 0.05
"""The least radius of a sphere of the corridor, metres, so that no obstruction is infinite."""
AROUND_M = 0.4
"""How far a sphere may stand from the path along each axis, metres."""
CONES = np.cos(np.pi / np.array([5.0, 6.0, 8.0, 12.0]))
"""Cosines of the cones around the direction of flight: half angles of 36, 30, 22.5 and 15°."""
WEIGHTS = np.array([0.05, 0.1, 0.3, 0.55])
"""What the nearest obstacle between one cone and the next, or in the last one, counts."""


def hardness(
    paths: Sequence[Ints],
    occupancy: Mask,
    tudf: Field,
    voxel_m: float,
) -> Vector:
    """`obstruction`, `occlusion` and `turning` of `scenegen.truth.difficulty.Difficulty` along
    `paths`; NaN where there is none.

    Args:
        paths: Of each its voxels (n, 3) from the middle outwards, at least two.
        occupancy: Truth (nx, ny, nz).
        tudf: Its distances (nx, ny, nz), metres.
        voxel_m: Edge of a voxel, metres.
    """
    radii: list[float] = []
    seen: list[float] = []
    turns, length = 0.0, 0.0
    for path in paths:
        corners: Floats = _shortened(path, occupancy) * np.float64(voxel_m)
        along = np.diff(corners, axis=0)
        steps = np.sqrt((along * along).sum(axis=1))
        units: Floats = along / steps[:, None]
        angles = np.arccos(np.clip((units[1:] * units[:-1]).sum(axis=1), -1.0, 1.0))
        turns += float((np.exp(2 * angles / np.pi) - 1).sum())
        length += float(steps.sum())
        until = np.cumsum(steps)
        at = 0.0
        while at < until[-1]:  # the corridor: the next sphere stands on the edge of the last one
            place, _ = _place(at, corners, units, until)
            voxel, around = np.rint(place / voxel_m).astype(int), round(AROUND_M / voxel_m)
            box = tuple(slice(max(n - around, 0), n + around + 1) for n in voxel.tolist())
            radii.append(max(float(tudf[box].max()) - ROBOT_M, LEAST_RADIUS_M))
            at += max(radii[-1], voxel_m)
        for at in np.arange(STEP_M, until[-1], STEP_M).tolist():
            place, unit = _place(at, corners, units, until)
            near = voxel_m * _nearest(occupancy, place / voxel_m, unit, SENSING_M / voxel_m)
            seen.append(float((WEIGHTS * SENSING_M / near).sum()))
    if not radii:
        return math.nan, math.nan, math.nan
    narrow = np.sort(radii)[: max(len(radii) // 2, 1)]
    obstruction = float(SENSING_M / 2 * (1 / narrow).mean())
    return obstruction, float(np.mean(seen)) if seen else math.nan, turns / length


def _place(at: float, corners: Floats, units: Floats, until: Floats) -> tuple[Floats, Floats]:
    """The point (3,) of a path so many metres along it, and the direction (3,) there."""
    leg = min(int(np.searchsorted(until, at, side="right")), len(units) - 1)
    return corners[leg + 1] + (at - until[leg]) * units[leg], units[leg]


def _shortened(path: Ints, occupancy: Mask) -> Ints:
    """The corners of a path whose ends see each other: from each, the farthest that it sees."""
    kept = [0]
    while kept[-1] < len(path) - 1:
        far = len(path) - 1
        while far > kept[-1] + 1 and not _sees(occupancy, path[kept[-1]], path[far]):
            far -= 1
        kept.append(far)
    return path[kept]


@kernel
def _sees(occupancy, one, other):
    """Whether the line between the centres of two voxels crosses free voxels alone (Amanatides and
    Woo 1987)."""
    at, step, apart = one.copy(), np.sign(other - one), np.abs(other - one)
    next_at = np.full(3, np.inf)
    for axis in range(3):
        if apart[axis]:
            next_at[axis] = 0.5 / apart[axis]
    for _ in range(apart.sum()):
        nearest = np.argmin(next_at)
        at[nearest] += step[nearest]
        next_at[nearest] += 1.0 / apart[nearest]
        if occupancy[at[0], at[1], at[2]]:
            return False
    return True


@kernel
def _nearest(occupancy, place, unit, reach):
    """Distances in voxels to the nearest occupied voxel's centre between one cone and the next,
    (4,); infinite where there is none within `reach`."""
    found = np.full(len(CONES), np.inf)
    low = np.maximum(np.ceil(place - reach), 0.0).astype(np.int64)
    shape = np.array(occupancy.shape)
    high = np.minimum(np.floor(place + reach).astype(np.int64) + 1, shape)
    for x in range(low[0], high[0]):
        for y in range(low[1], high[1]):
            for z in range(low[2], high[2]):
                if occupancy[x, y, z]:
                    dx, dy, dz = x - place[0], y - place[1], z - place[2]
                    ahead = dx * unit[0] + dy * unit[1] + dz * unit[2]
                    # a path may touch a voxel between two nodes
                    far = max(math.sqrt(dx * dx + dy * dy + dz * dz), 0.5)
                    if far <= reach and ahead >= CONES[0] * far:
                        cone = 0
                        while cone < len(CONES) - 1 and ahead >= CONES[cone + 1] * far:
                            cone += 1
                        found[cone] = min(found[cone], far)
    return found
