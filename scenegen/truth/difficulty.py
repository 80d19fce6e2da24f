"""How hard a map is to see through and to fly through, measured on its truth.

The five figures of BARN (Perille et al. 2020, arXiv 2008.13315), which are planar there, in three
dimensions and around the map's middle, where the sensor is unless a recipe puts the map elsewhere;
and the traversability and the relative gap size of AvoidBench (Yu et al. 2023, arXiv 2301.07430).
All are exact for the voxels: nothing is sampled at random. The searches for shortest paths on the
lattice of voxels, A* and Dijkstra's algorithm, are here, too."""

import functools
import heapq
import itertools
import math
from typing import NamedTuple

import numpy as np

from lidarsim.grid import Field, Floats, Ints, Mask, Vector
from lidarsim.jit import kernel

TIE = 1e-9
"""Paths whose lengths differ by less, in lattice steps, count as equal, because of rounding."""


NO_RISK = np.empty((0, 0, 0), np.float32)
"""A `risk` for `search` that weighs paths only by length."""


@kernel
def search(occupied, first, shape, step, start, goal, edge_check, risk, weight):
    """Find the shortest path between two free nodes of a lattice.

    Node (a, b, c) is voxel `first` + `step` (a, b, c) of `occupied`. Lengths are in lattice steps,
    and longer by `weight` times the mean `risk` on the way, unless `risk` is empty.

    Args:
        occupied: (nx, ny, nz): voxels that block.
        first: (3,): the voxel of node (0, 0, 0).
        shape: (3,): nodes along each axis.
        step: Voxels from node to node.
        start: (3,): a free node.
        goal: (3,): a free node. Beyond the lattice, it ends the path at the outermost node from
            which the straight line to it makes the shortest way.
        edge_check: Whether the voxels between two nodes must be free, too.
        risk: (nx, ny, nz), or `NO_RISK`.
        weight: The weight of risk.

    Returns:
        Nodes (n, 3) from `start` to `goal`; (0, 3) without a path.
    """
    length, parent, target = explore(
        occupied, first, shape, step, start, goal, edge_check, risk, weight
    )
    if target < 0 or not math.isfinite(length[target]):
        return np.empty((0, 3), np.int64)
    # from the end to the start, along each node's predecessor
    back = [target]
    while parent[back[-1]] >= 0:
        back.append(np.int64(parent[back[-1]]))
    nodes, (_, nb, nc) = np.array(back)[::-1], shape
    return np.stack((nodes // (nb * nc), nodes // nc % nb, nodes % nc), axis=1)


@kernel
def explore(occupied, first, shape, step, start, goal, edge_check, risk, weight):
    """Find the shortest paths from `start` to the nodes of a lattice.

    The straight line to the goal never exceeds the rest of a path, nor falls by more than an edge
    is long, so the first arrival is the shortest (A*).

    Args:
        occupied, first, shape, step, start, edge_check, weight: As for `search`.
        goal: As for `search`; None finds the paths to all nodes (Dijkstra 1959).
        risk: As for `search`; None weighs only lengths. A None spares numba the code for it.

    Returns:
        Per node, in C order: the length of its shortest path, infinite for none; and the number of
        the node before it on that path, -1 for none. Then the number of the node that ends the path
        to the goal, -1 for none.
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
        # of equal estimates, the one that has walked farther comes first: fewer nodes are opened
        _, walked, node = heapq.heappop(heap)
        walked = -walked
        if node == target:
            break
        # a shorter path came after this entry was pushed
        if walked > length[node]:
            continue
        a, b, c = node // (nb * nc), node // nc % nb, node % nc
        # the goal lies outside: the first node on the rim has the shortest total
        if not inside and (min(a, b, c) == 0 or a == na - 1 or b == nb - 1 or c == nc - 1):
            target = node
            break
        for i in range(max(a - 1, 0), min(a + 2, na)):
            for j in range(max(b - 1, 0), min(b + 2, nb)):
                for k in range(max(c - 1, 0), min(c + 2, nc)):
                    neighbour = (i * nb + j) * nc + k
                    x, y, z = x0 + step * i, y0 + step * j, z0 + step * k
                    # each difference is -1, 0 or 1, so it equals its square
                    reach = math.sqrt(abs(i - a) + abs(j - b) + abs(k - c))
                    if risk is not None and len(risk) > 0:
                        met = _sum_along(risk, x, y, z, a - i, b - j, c - k, step)
                        reach += weight * reach * met / step
                    reached = walked + reach
                    if reached > length[neighbour] - TIE:
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
                    length[neighbour] = reached
                    parent[neighbour] = node
                    heapq.heappush(heap, (reached + left, -reached, neighbour))
    return length, parent, target


@kernel
def _sum_along(values, x, y, z, dx, dy, dz, step):
    """Sum `values` over `step` voxels from (x, y, z) on along (dx, dy, dz), each -1, 0 or 1."""
    total = 0.0
    for n in range(step):
        total += values[x + n * dx, y + n * dy, z + n * dz]
    return total


STEP_M = 0.6
"""Edge of the lattice for paths, metres, as in the paper's planner."""
BODY_M = 0.6
"""Diameter of the robot, the unit of traversability, metres."""
DIRECTIONS = np.array(
    [step for step in itertools.product((-1, 0, 1), repeat=3) if step != (0, 0, 0)], np.int64
)
"""The 26 directions to the neighbours of a voxel; the n-th and the n-th last are opposite."""


class Difficulty(NamedTuple):
    """The figures of one map; NaN where one is undefined."""

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
    """Measure a map.

    Args:
        occupancy: Truth (nx, ny, nz).
        tudf: Its distances (nx, ny, nz), metres.
        voxel_m: Edge of a voxel, metres.

    Returns:
        Its figures; clearance 0 and all others NaN if the middle is occupied.
    """
    centre, step = np.array(occupancy.shape) // 2, max(round(STEP_M / voxel_m), 1)
    # a sensor inside an obstacle sees nothing
    if occupancy[tuple(centre)]:
        return Difficulty(0.0, *[math.nan] * 6)
    tortuosity = _tortuosity(_ways_out(occupancy, centre, step), centre // step)
    return _measured(centre[None], step, tortuosity, occupancy, tudf, voxel_m)


def way_difficulty(
    way: Ints, tortuosity: float, occupancy: Mask, tudf: Field, voxel_m: float
) -> Difficulty:
    """Measure a path through a map: figures of the map's middle become means along the path.

    Args:
        way: The path's voxels (n, 3), each free and next to the one before, at least two.
        tortuosity: The path's own. Its voxels do not tell it: they make a straight path up to 1.13
            times as long.
        occupancy: Truth (nx, ny, nz).
        tudf: Its distances (nx, ny, nz), metres.
        voxel_m: Edge of a voxel, metres.

    Returns:
        The path's figures.
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
    """Average the figures around the voxels `stops` (n, 3), on the lattice of the first."""
    around = np.mean([_around(occupancy, stop, voxel_m) for stop in stops], axis=0)
    ways = _mean_ways(occupancy, stops[0], step, DIRECTIONS[DIRECTIONS[:, 2] == 0])
    level = (float(way) * voxel_m / BODY_M for way in ways)
    clearance = float(tudf[tuple(stops.T)].mean())
    return Difficulty._make([clearance, *around.tolist(), tortuosity, *level])


def _around(occupancy: Mask, place: Ints, voxel_m: float) -> Vector:
    """Measure visibility, dispersion and passage at a free voxel (3,), see `Difficulty`."""
    seen = [_way(occupancy, *place.tolist(), *ahead) for ahead in DIRECTIONS.tolist()]
    ways, blocked = np.array(seen).T
    lengths = voxel_m * ways * np.sqrt((DIRECTIONS**2).sum(axis=1))
    near, far = _neighbours()
    differ = float((blocked[near] != blocked[far]).mean())
    # DIRECTIONS reversed are the opposite ones, so the sums are axes through the voxel
    return float(lengths.mean()), differ, float((lengths + lengths[::-1]).min())


@functools.cache
def _neighbours() -> tuple[Ints, Ints]:
    """List pairs of directions that are at most 45 degrees apart."""
    length = np.sqrt((DIRECTIONS**2).sum(axis=1))
    products = (DIRECTIONS[:, None] * DIRECTIONS[None]).sum(axis=2)
    # each pair once; 1e-9 for rounding at exactly 45 degrees
    near, far = np.nonzero(products >= (math.sqrt(0.5) - 1e-9) * length[:, None] * length[None])
    return near[near < far], far[near < far]


@kernel
def _way(occupancy, x, y, z, dx, dy, dz):
    """Count steps from a free voxel to the last free one in a direction; and tell whether an
    occupied one ends them."""
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
    """Average over the free nodes of the middle's lattice, in voxels: the way in a direction, and
    the shortest way there and back.

    The n-th direction and the n-th last must be opposite."""
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
    """Compute the length of the shortest path from the middle to every node of its lattice, in
    steps.

    It runs through free voxels; infinite for none."""
    first, start = middle % step, middle // step
    counts = (np.array(occupancy.shape) - 1 - first) // step + 1
    # a wall may stand between two nodes
    length, *_ = explore(occupancy, first, counts, step, start, None, True, None, 0.0)
    return length.reshape(counts)


def _tortuosity(length: Floats, start: Ints) -> float:
    """Average path length over that in an empty map, over the reached nodes of the lateral
    faces."""
    nodes = np.argwhere((length > 0) & np.isfinite(length))
    lateral = nodes[((nodes == 0) | (nodes == np.array(length.shape) - 1))[:, :2].any(axis=1)]
    if not len(lateral):
        return math.nan
    # in an empty map a path takes diagonal steps as long as it can
    low, middle, high = np.sort(abs(lateral - start)).T
    empty = (high - middle) + math.sqrt(2.0) * (middle - low) + math.sqrt(3.0) * low
    return float((length[tuple(lateral.T)] / empty).mean())
