"""Laws of the tree: it holds every item once, within its boxes, whatever the items are."""

import numpy as np
import pytest

from lidarsim.engines.hierarchy import IN_LEAF, LEVELS, Hierarchy


def leaves(tree, lower, upper):
    """All items, in the order in which the tree's leaves hold them, and its depth; boxes are
    checked on the way."""
    items = []
    deepest, waiting = 0, [(0, 1)] if len(tree.boxes) else []
    while waiting:
        node, level = waiting.pop()
        deepest = max(deepest, level)
        for k in range(4):
            low, high = tree.boxes[node, :3, k], tree.boxes[node, 3:, k]
            link, end = int(tree.links[node, k]), int(tree.ends[node, k])
            if end:
                held = tree.order[link:end].astype(int)
                assert 1 <= len(held) <= IN_LEAF
                assert (low <= lower[held]).all()
                assert (high >= upper[held]).all()
                items += held.tolist()
            elif link:
                assert link > node
                inside = np.isfinite(tree.boxes[link, 0])
                assert (low <= tree.boxes[link, :3][:, inside].min(axis=1)).all()
                assert (high >= tree.boxes[link, 3:][:, inside].max(axis=1)).all()
                waiting.append((link, level + 1))
            else:
                assert (low > high).all()  # no ray enters it
    return items, deepest


def boxes(rng, count, kind):
    centre = rng.uniform(-50, 50, (count, 3))
    if kind == "coincident":
        centre[:] = 7.0
    elif kind == "on a line":
        centre[:, 1:] = 0.0
    elif kind == "ever farther":  # every cut takes few items off
        centre = np.repeat(1.5 ** np.arange(count)[:, None] * 1e-6, 3, axis=1) % 1e6
    half = rng.uniform(0.0, 2.0, (count, 3))
    return centre - half, centre + half


@pytest.mark.parametrize("kind", ["scattered", "coincident", "on a line", "ever farther"])
@pytest.mark.parametrize("count", [0, 1, 5, 300])
def test_every_item_lies_in_one_leaf_within_its_boxes(kind, count):
    lower, upper = boxes(np.random.default_rng(count), count, kind)
    tree = Hierarchy.over(lower, upper)
    items, depth = leaves(tree, lower, upper)
    assert sorted(items) == list(range(count))
    assert depth <= LEVELS + 32
    assert kind != "coincident" or depth <= count.bit_length()  # else the tree is deep
    moved = np.random.default_rng(1).uniform(-3, 3, (count, 3))
    tree.refit(lower + moved, upper + moved)
    assert leaves(tree, lower + moved, upper + moved) == (items, depth)


def test_neighbours_share_leaves(rng):
    """The tree of two heaps far apart is cut between them."""
    lower = np.concatenate([rng.uniform(0, 1, (8, 3)), rng.uniform(100, 101, (8, 3))])
    tree = Hierarchy.over(lower, lower + 0.1)
    for link, end in zip(tree.links.ravel(), tree.ends.ravel(), strict=True):
        assert len(set((tree.order[int(link) : int(end)] // 8).tolist())) <= 1
