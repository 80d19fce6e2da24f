"""A bounding volume hierarchy of boxes: a ray skips the groups whose box it misses.

Groups are cut where the surface area heuristic (Goldsmith and Salmon 1987) expects the least work,
in bins (Wald 2007). Every node has up to four children (Dammertz et al. 2008), so that a ray visits
fewer nodes than in a binary tree."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats
from lidarsim.jit import kernel

WIDTH = 4
"""The most children of a node."""
IN_LEAF = 4
"""The most items of a group that is not cut."""
BINS = 16
"""Places along an axis at which a group may be cut."""
LEVELS = 40
"""Levels of the tree below which groups are halved by count, so that no tree is deeper than 32
more."""
WAITING = (WIDTH - 1) * (LEVELS + 32) + WIDTH
"""The longest stack while a tree of fewer than 2³² items is walked, nearest child first."""
SPARE = 1e-9
"""Padding of boxes against rounding: 1e-9 of one metre plus the coordinate."""


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """A tree over n items, with m nodes. Node 0 is the root; children have greater numbers than
    their parents."""

    boxes: Floats
    """(m, 6, 4): least and greatest corner of every child's box, metres. The box of a missing child
    has no inside."""
    links: NDArray[np.uint64]
    """(m, 4): a child's own node, or where the items of a leaf begin in `order`."""
    ends: NDArray[np.uint64]
    """(m, 4): where the items of a leaf end in `order`; 0 for a child that is a node."""
    order: NDArray[np.uint64]
    """(n,): the items, leaf by leaf."""

    @classmethod
    def over(cls, lower: Floats, upper: Floats) -> Self:
        """Build the tree over items.

        Args:
            lower: (n, 3): least corners of their boxes, metres, finite.
            upper: (n, 3): greatest corners.

        Returns:
            The tree.
        """
        # a node has three children or more, or two leaves that hold five items or more
        capacity = len(lower) // 2 + 1
        boxes = np.empty((capacity, 6, WIDTH))
        # boxes without an inside, which every ray misses
        boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
        links, ends = np.zeros((2, capacity, WIDTH), np.uint64)
        order = np.arange(len(lower), dtype=np.uint64)
        centre, bins = 0.5 * (lower + upper), np.empty((BINS + 1, 8))
        waiting = np.zeros((capacity, 4), np.int64)
        nodes = _build(lower, upper, centre, order, boxes, links, ends, bins, waiting)
        return cls(boxes[:nodes].copy(), links[:nodes].copy(), ends[:nodes].copy(), order)

    def refit(self, lower: Floats, upper: Floats) -> None:
        """Take the boxes of items that have moved.

        It is quicker than a new tree, and as good while neighbours stay neighbours.

        Args:
            lower: (n, 3): least corners, metres.
            upper: (n, 3): greatest corners.
        """
        _refit(lower, upper, self.boxes, self.links, self.ends, self.order)


@kernel
def _build(lower, upper, centre, order, boxes, links, ends, bins, waiting):
    """Fill boxes, links, ends and order from the root down; return the number of nodes.

    A row of `waiting` is a group: where it begins and ends in `order`, its node and its level.
    Arrays are made by the caller, since numba takes a second to compile their creation."""
    nodes = pending = min(len(order), 1)
    waiting[0, 1] = len(order)
    while pending > 0:
        pending -= 1
        begin, end, node, level = waiting[pending]
        # a binary cut, and a cut of both halves: four children
        middle = _cut(lower, upper, centre, order, begin, end, level, bins)
        quarter = _cut(lower, upper, centre, order, begin, middle, level, bins)
        last = _cut(lower, upper, centre, order, middle, end, level, bins)
        parts = begin, quarter, middle, last, end
        for k in range(WIDTH):
            begin, end = parts[k], parts[k + 1]
            if begin == end:
                continue
            _hull(lower, upper, order, begin, end, boxes[node, :, k])
            if end - begin <= IN_LEAF:
                links[node, k], ends[node, k] = begin, end
                continue
            links[node, k] = nodes
            group = waiting[pending]
            group[0], group[1], group[2], group[3] = begin, end, nodes, level + 1
            pending += 1
            nodes += 1
    return nodes


@kernel
def _hull(lower, upper, order, begin, end, box):
    """Make `box` (6,) hold the items order[begin:end], with padding."""
    for a in range(3):
        low, high = np.inf, -np.inf
        for q in range(begin, end):
            low, high = min(low, lower[order[q], a]), max(high, upper[order[q], a])
        box[a], box[3 + a] = low - SPARE * (1.0 + abs(low)), high + SPARE * (1.0 + abs(high))


@kernel
def _cut(lower, upper, centre, order, begin, end, level, bins):
    """Sort order[begin:end] into two parts; return where the second begins, `end` for a leaf.

    A row of `bins` is a box, the count of items whose centre is in the bin, and the cost of all
    bins from this one on; the last row is a box that grows."""
    if end - begin <= IN_LEAF:
        return end
    # the axis along which centres spread farthest
    axis, first, width = 0, 0.0, 0.0
    for a in range(3):
        low, high = np.inf, -np.inf
        for q in range(begin, end):
            low, high = min(low, centre[order[q], a]), max(high, centre[order[q], a])
        if high - low > width:
            axis, first, width = a, low, high - low
    scale = BINS / width if width > 0.0 else np.inf
    if not scale < np.inf or level >= LEVELS:  # all centres are equal, or the tree too deep
        return (begin + end) // 2
    for b in range(BINS):
        _empty(bins[b])
        bins[b, 6] = 0.0
    for q in range(begin, end):
        g = order[q]
        b = min(int((centre[g, axis] - first) * scale), BINS - 1)
        bins[b, 6] += 1.0
        for a in range(3):
            bins[b, a] = min(bins[b, a], lower[g, a])
            bins[b, 3 + a] = max(bins[b, 3 + a], upper[g, a])
    box, count = bins[BINS], 0.0
    _empty(box)
    for b in range(BINS - 1, 0, -1):
        count += bins[b, 6]
        bins[b, 7] = _grown(box, bins[b]) * count
    _empty(box)
    # the first bin holds the item of least centre, the last that of the greatest
    lowest_cost, last_bin, count = np.inf, 0, 0.0
    for b in range(BINS - 1):
        count += bins[b, 6]
        cost = _grown(box, bins[b]) * count + bins[b + 1, 7]
        if cost < lowest_cost:
            lowest_cost, last_bin = cost, b
    # partition in place, as quicksort does
    i, j = begin, end - 1
    while i <= j:
        if min(int((centre[order[i], axis] - first) * scale), BINS - 1) <= last_bin:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i


@kernel
def _empty(box):
    """Make `box` hold nothing."""
    for a in range(3):
        box[a], box[3 + a] = np.inf, -np.inf


@kernel
def _grown(box, added):
    """Grow `box` around `added`; return half its surface, 0 while it holds nothing."""
    for a in range(3):
        box[a], box[3 + a] = min(box[a], added[a]), max(box[3 + a], added[3 + a])
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x if x >= 0.0 else 0.0


@kernel
def _refit(lower, upper, boxes, links, ends, order):
    """Recompute boxes from the last node to the first, so that children come before parents."""
    for node in range(len(boxes) - 1, -1, -1):
        for k in range(WIDTH):
            link, end = links[node, k], ends[node, k]
            if end > 0:
                _hull(lower, upper, order, link, end, boxes[node, :, k])
            elif link > 0:  # else there is no such child: none is the root
                for a in range(3):
                    boxes[node, a, k] = boxes[link, a].min()
                    boxes[node, 3 + a, k] = boxes[link, 3 + a].max()
