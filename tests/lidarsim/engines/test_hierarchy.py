"""Whatever the tree is made of, and wherever its items go, rays meet the nearest of all spheres."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarsim import AnalyticEngine
from lidarsim.engines.hierarchy import Hierarchy
from lidarsim.solids import solids_of
from tests.lidarsim import reference
from tests.lidarsim.engines.test_laws import model_of
from tests.refusals import refuses

KINDS = ("scattered", "coincident", "on a line", "ever farther")


def centres(rng, count, kind):
    places = rng.uniform(-50, 50, (count, 3))
    if kind == "coincident":
        places[:] = 7.0
    elif kind == "on a line":
        places[:, 1:] = 0.0
    elif kind == "ever farther":  # every cut takes few items off
        places = np.repeat(1.5 ** np.arange(count)[:, None] * 1e-6, 3, axis=1) % 1e6
    return places


def crowd(count, places=None):
    """As many unit balls, (count, 3), or all 5 m ahead."""
    ball = solids_of(model_of('size="1" pos="5 0 0"'))
    names = ("shape", "size", "position", "rotation", "lower", "upper")
    many = {name: np.repeat(getattr(ball, name), count, axis=0) for name in names}
    if places is not None:
        many |= {"position": places, "lower": places - 1, "upper": places + 1}
    return replace(ball, **many, geom=np.arange(count))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 5, 300])
def test_rays_meet_the_nearest_of_all(kind, count):
    rng, engine = np.random.default_rng(count), None
    rays = reference.unit(rng.normal(size=(2000, 3)))
    for _ in range(2):  # as built, and as moved
        places = centres(rng, count, kind) + rng.uniform(-3, 3, (count, 3))
        rays[:count] = reference.unit(places)
        solids = crowd(count, places)
        if engine is None:
            engine = AnalyticEngine(solids)
        else:
            engine.move(solids)
        near, far = reference.interval("sphere", [1.0], -places, rays[:, None])
        first = np.where(near > 0, near, np.where(far > 0, far, np.inf)).min(axis=1)
        ranges = engine.cast(np.zeros((1, 3)), rays[None], np.inf)[0]
        assert_allclose(ranges, first, rtol=1e-9, atol=1e-4)


def test_of_many_as_near_the_first_is_met():
    hits = AnalyticEngine(crowd(100_000)).hits([[0.0, 0.0, 0.0]], [[[1.0, 0.0, 0.0]]], 10.0)
    assert hits.ranges == 4.0
    assert hits.geoms == 0
    refuses("a crowd in place of one", AnalyticEngine(crowd(1)).move, crowd(2))


def test_neighbours_share_leaves(rng):
    """The tree of two heaps far apart is cut between them."""
    lower = np.concatenate([rng.uniform(0, 1, (8, 3)), rng.uniform(100, 101, (8, 3))])
    tree = Hierarchy.over(lower, lower + 0.1)
    for link, end in zip(tree.links.ravel(), tree.ends.ravel(), strict=True):
        assert len(set((tree.order[int(link) : int(end)] // 8).tolist())) <= 1
