"""How hard a map is to see through and to fly through, from its truth alone.

The five figures of BARN (Perille et al. 2020, arXiv 2008.13315), which are planar there, in three
dimensions and around the map's middle, where the sensor is unless a recipe puts the map elsewhere;
and the traversability and the relative gap size of AvoidBench (Yu et al. 2023, arXiv 2301.07430).
All are exact for the voxels: nothing is sampled at random. Shortest ways on the lattice of voxels,
by A* and by Dijkstra's algorithm, are found here, too.
"""

import functools
import heapq
import itertools
import math
from typing import NamedTuple

import numpy as np

from lidarsim.grid import Field, Floats, Ints, Mask, Vector
from lidarsim.jit import kernel

TIE = 1e-9
"""Paths whose lengths differ by less, in lattice steps, are equally long: what differs is
rounding."""


NO_RISK = np.empty((0, 0, 0), np.float32)
"""Says to `search` that ways are weighed by their lengths alone."""


@kernel
def search(occupied, first, shape, step, start, goal, edge_check, risk, weight):
    """Nodes (n, 3) from `start` to `goal`, both free; (0, 3) where no path is. Lengths are in
    lattice steps, and longer by `weight` times the mean `risk` on the way, unless that is empty.

    Node (a, b, c) of a lattice of `shape` is voxel `first` + `step` (a, b, c) of `occupied`. With
    `edge_check` the voxels between two nodes must be free, too. A goal beyond the lattice ends the
    path at the outermost node from which the straight line to it makes the shortest way.
    """
    length, parent, target = explore(
        occupied, first, shape, step, start, goal, edge_check, risk, weight
    )
    if target < 0 or not math.isfinite(length[target]):
        return np.empty((0, 3), np.int64)
    back = [target]
    while parent[back[-1]] >= 0:
        back.append(np.int64(parent[back[-1]]))
    nodes, (_, nb, nc) = np.array(back)[::-1], shape
    return np.stack((nodes // (nb * nc), nodes // nc % nb, nodes % nc), axis=1)


@kernel
def explore(occupied, first, shape, step, start, goal, edge_check, risk, weight):
    """The length of the shortest way from `start` to every node of the lattice, one after the
    other, and the number of the node before it on that way; infinite and -1 for none. And the
    number of the node that ends the path to the goal, -1 for none.

    For the arguments see `search`. A `goal` of None makes it find the ways to all nodes (Dijkstra
    1959), a `risk` of None weighs none; either spares numba the code for it.

    The straight line to the goal never exceeds what is left of a path, nor falls by more than an
    edge is long, so the first arrival is the shortest.
    """
    (x0, y0, z0), (na, nb, nc) = first, shape
    length = np.full(na * nb * nc, np.inf)
    parent = np.full(len(length), -1, np.int32)
    origin = (start[0] * nb + start[1]) * nc + start[2]
    inside, target = True, -1
    if goal is not None:
        inside = (goal >= 0).all() and (goal < shape).all()
        target = (goal[0] * nb + goal[1]) * nc + goal[2] if inside else -1
    length[origin] = 0.0
    heap, checked = [(0.0, 0.0, origin)], step if edge_check else 1
    while len(heap) > 0:
        _, walked, node = heapq.heappop(heap)
        walked = -walked
        if node == target:
            break
        if walked > length[node]:
            continue
        a, b, c = node // (nb * nc), node // nc % nb, node % nc
        if not inside and (min(a, b, c) == 0 or a == na - 1 or b == nb - 1 or c == nc - 1):
            target = node
            break
        for i in range(max(a - 1, 0), min(a + 2, na)):
            for j in range(max(b - 1, 0), min(b + 2, nb)):
                for k in range(max(c - 1, 0), min(c + 2, nc)):
                    there = (i * nb + j) * nc + k
                    x, y, z = x0 + step * i, y0 + step * j, z0 + step * k
                    reach = math.sqrt(abs(i - a) + abs(j - b) + abs(k - c))
                    if risk is not None and len(risk) > 0:
                        met = _sum_along(risk, x, y, z, a - i, b - j, c - k, step)
                        reach += weight * reach * met / step
                    reached = walked + reach
                    if reached > length[there] - TIE:
                        continue
                    # from centre to centre along such a direction a segment runs through the voxels
                    # stepped on and, at corners and edges, past the others without entering them
                    if _sum_along(occupied, x, y, z, a - i, b - j, c - k, checked) > 0:
                        continue
                    left = 0.0
                    if goal is not None:
                        left = math.sqrt(
                            (goal[0] - i) ** 2 + (goal[1] - j) ** 2 + (goal[2] - k) ** 2
                        )
                    length[there] = reached
                    parent[there] = node
                    heapq.heappush(heap, (reached + left, -reached, there))
    return length, parent, target


@kernel
def _sum_along(values, x, y, z, dx, dy, dz, step):
    """The sum of `values` in the `step` voxels from (x, y, z) on along (dx, dy, dz), each -1, 0 or
    1."""
    total = 0.0
    for n in range(step):
        total += values[x + n * dx, y + n * dy, z + n * dz]
    return total


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
