"""Shortest ways on a lattice of voxels: A* to a goal, and Dijkstra's to all nodes."""

import heapq
import math

import numpy as np

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
