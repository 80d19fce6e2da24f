"""How hard a map is to see through and to fly through, from its truth alone.

The five figures of BARN (Perille et al. 2020, arXiv 2008.13315), which are planar there, in three
dimensions and around the map's middle, where the sensor is unless a recipe puts the map elsewhere;
and the traversability and the relative gap size of AvoidBench (Yu et al. 2023, arXiv 2301.07430).
All are exact for the voxels: nothing is sampled at random.
"""

import functools
import itertools
import math
from typing import NamedTuple

import numpy as np

from lidarsim.grid import Field, Floats, Ints, Mask, Vector
from lidarsim.jit import kernel
from scenegen.truth.search import explore

STEP_M = 0.6
"""The lattice on which ways are looked for: the paper's planner's."""
BODY_M = 0.6
"""Diameter of the robot that traversability counts in."""
DIRECTIONS = np.array(
    [one for one in itertools.product((-1, 0, 1), repeat=3) if one != (0, 0, 0)], np.int64
)
"""The 26 directions to the neighbours of a voxel; the n-th and the n-th last are opposite."""


class Difficulty(NamedTuple):
    """The figures of one map; NaN where there is nothing to measure."""

    clearance_m: float
    """From the middle to the centre of the nearest occupied voxel, metres, at most the
    truncation."""
    visibility_m: float
    """Mean over the 26 directions of the way from the middle to an occupied voxel or the map's
    edge, metres."""
    dispersion: float
    """The share of pairs of neighbouring directions, 45 degrees apart or less, of which one is
    blocked within the map and the other is not."""
    passage_m: float
    """The characteristic dimension: over the 13 axes through the middle, the shortest way from
    occupied voxel to occupied voxel, metres; map edges count as such."""
    tortuosity: float
    """Mean over the nodes of the map's lateral faces that can be reached of the length of the
    shortest way over the straight distance: 1 in an empty map. Nodes lie `STEP_M` apart and have 26
    neighbours, so that some ways are up to 1.13 times as long in an empty map, too: each is divided
    by its length there."""
    traversability: float
    """Mean over the free nodes and the eight level directions of the way to an occupied voxel or
    the map's edge, in diameters of the robot."""
    gap: float
    """Mean over the free nodes of the shortest way from obstacle to obstacle through the node, of
    those along the four level axes, in diameters of the robot; map edges count as obstacles."""


def difficulty(occupancy: Mask, tudf: Field, voxel_m: float) -> Difficulty:
    """The figures of a map.

    Args:
        occupancy: Truth (nx, ny, nz).
        tudf: Its distances (nx, ny, nz), metres.
        voxel_m: Edge of a voxel, metres.
    """
    centre, step = np.array(occupancy.shape) // 2, max(round(STEP_M / voxel_m), 1)
    if occupancy[tuple(centre)]:
        return Difficulty(0.0, *[math.nan] * 6)
    tortuosity = _tortuosity(_ways_out(occupancy, centre, step), centre // step)
    return _measured(centre[None], step, tortuosity, occupancy, tudf, voxel_m)


def way_difficulty(
    way: Ints, tortuosity: float, occupancy: Mask, tudf: Field, voxel_m: float
) -> Difficulty:
    """The figures of a way through a map: those that are of the map's middle otherwise are means
    along the way.

    Args:
        way: Its voxels (n, 3), each free and next to the one before, at least two.
        tortuosity: Its own. Voxels do not tell it: they make a straight way up to 1.13 times as
            long.
        occupancy: Truth (nx, ny, nz).
        tudf: Its distances (nx, ny, nz), metres.
        voxel_m: Edge of a voxel, metres.
    """
    step = max(round(STEP_M / voxel_m), 1)
    return _measured(way[::step], step, tortuosity, occupancy, tudf, voxel_m)


def _measured(
    stops: Ints,
    step: int,
    tortuosity: float,
    occupancy: Mask,
    tudf: Field,
    voxel_m: float,
) -> Difficulty:
    """The figures around the voxels `stops` (n, 3), as means, on the lattice of the first."""
    around = np.mean([_around(occupancy, stop, voxel_m) for stop in stops], axis=0)
    ways = _mean_ways(occupancy, stops[0], step, DIRECTIONS[DIRECTIONS[:, 2] == 0])
    level = (float(way) * voxel_m / BODY_M for way in ways)
    clearance = float(tudf[tuple(stops.T)].mean())
    return Difficulty._make([clearance, *around.tolist(), tortuosity, *level])


def _around(occupancy: Mask, place: Ints, voxel_m: float) -> Vector:
    """Visibility, dispersion and passage at a free voxel (3,), see `Difficulty`."""
    seen = [_way(occupancy, *place.tolist(), *ahead) for ahead in DIRECTIONS.tolist()]
    ways, blocked = np.array(seen).T
    lengths = voxel_m * ways * np.sqrt((DIRECTIONS**2).sum(axis=1))
    near, far = _neighbours()
    differ = float((blocked[near] != blocked[far]).mean())
    return float(lengths.mean()), differ, float((lengths + lengths[::-1]).min())


@functools.cache
def _neighbours() -> tuple[Ints, Ints]:
    """Pairs of directions that are at most 45 degrees apart."""
    length = np.sqrt((DIRECTIONS**2).sum(axis=1))
    products = (DIRECTIONS[:, None] * DIRECTIONS[None]).sum(axis=2)
    near, far = np.nonzero(products >= (math.sqrt(0.5) - 1e-9) * length[:, None] * length[None])
    return near[near < far], far[near < far]


@kernel
def _way(occupancy, x, y, z, dx, dy, dz):
    """Steps from a free voxel to the last free one in a direction, and whether an occupied one ends
    them."""
    nx, ny, nz = occupancy.shape
    steps = 0
    while True:
        x, y, z = x + dx, y + dy, z + dz
        if x < 0 or y < 0 or z < 0 or x >= nx or y >= ny or z >= nz:
            return steps, False
        if occupancy[x, y, z]:
            return steps, True
        steps += 1


@kernel
def _mean_ways(occupancy, middle, step, directions):
    """Means over the free nodes of the middle's lattice, in voxels: of the way in a direction, and
    of the shortest way there and back. The n-th direction and the n-th last are opposite."""
    nx, ny, nz = occupancy.shape
    total, gaps, count = 0.0, 0.0, 0
    ways = np.empty(len(directions))
    for x in range(middle[0] % step, nx, step):
        for y in range(middle[1] % step, ny, step):
            for z in range(middle[2] % step, nz, step):
                if not occupancy[x, y, z]:
                    for n in range(len(directions)):
                        dx, dy, dz = directions[n]
                        steps = _way(occupancy, x, y, z, dx, dy, dz)[0]
                        ways[n] = steps * math.sqrt(dx * dx + dy * dy + dz * dz)
                    total += ways.mean()
                    gaps += (ways + ways[::-1]).min()
                    count += 1
    return (total / count, gaps / count) if count else (np.nan, np.nan)


def _ways_out(occupancy: Mask, middle: Ints, step: int) -> Floats:
    """The length of the shortest way from the middle to every node of its lattice through free
    voxels, in steps; infinite for none."""
    first, start = middle % step, middle // step
    counts = (np.array(occupancy.shape) - 1 - first) // step + 1
    # a wall may stand between two nodes
    length, *_ = explore(occupancy, first, counts, step, start, None, True, None, 0.0)
    return length.reshape(counts)


def _tortuosity(length: Floats, start: Ints) -> float:
    """The mean over reached nodes of the lateral faces of the shortest way over that in an empty
    map."""
    nodes = np.argwhere((length > 0) & np.isfinite(length))
    lateral = nodes[((nodes == 0) | (nodes == np.array(length.shape) - 1))[:, :2].any(axis=1)]
    if not len(lateral):
        return math.nan
    low, middle, high = np.sort(abs(lateral - start)).T
    empty = (high - middle) + math.sqrt(2.0) * (middle - low) + math.sqrt(3.0) * low
    return float((length[tuple(lateral.T)] / empty).mean())
