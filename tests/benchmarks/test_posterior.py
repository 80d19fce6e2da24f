"""Chains of worlds that look the same: their laws are the prior's, given what was seen."""

import importlib

import numpy as np
import pytest

from lidarsim import AnalyticEngine, GridSpec, Lidar, Pose, cast, voxelize
from scenegen.worlds.kinds.pillar import Pillar
from tests.command_line import ROOT

pytestmark = pytest.mark.slow
TOY = Pillar(
    size_m=(6.0, 5.0, 10.0),
    density=(0.1, 0.2),
    half_width_m=(0.1, 1.0),
    passage_share=0.3,
    passage_m=(0.2, 3.0),
)
"""Three to six pillars."""
MIDDLE = Pose(np.array([3.0, 2.5, 4.0]), np.array([1.0, 0.0, 0.0, 0.0]))
GRID = GridSpec(shape=(4, 4, 2), voxel_m=1.5, truncation_m=3.0)
ORIGIN = GRID.origin_at(MIDDLE.position)
BESIDE = ORIGIN + 100.0
"""Of a grid that no ray reaches: pillars return rays, and every world looks the same."""
CLEAR_M = 0.3
AROUND = Lidar(rows=1, columns=6, pitch_deg=0.0, vertical_fov_deg=1.0, max_range_m=4.0)
DOWN = Lidar(rows=1, columns=1, pitch_deg=90.0, vertical_fov_deg=1.0, max_range_m=4.0)
"""It sees nothing but what is below it, where no pillar is."""


@pytest.fixture
def posterior(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("posterior")


def seen(posterior, numbers, lidar, origin=ORIGIN):
    """What the library's own rays and voxels see of a world."""
    nothing = np.zeros(GRID.shape, bool)
    blind = posterior.Looked.of(MIDDLE, lidar, GRID, origin, nothing, nothing)
    prior = posterior.prior_of(TOY, CLEAR_M)
    world = posterior.Chain(blind, prior, numbers, 0)
    solids = posterior.solids_of(*world.world(), prior[posterior.HEIGHT])
    marked = voxelize(cast(AnalyticEngine(solids, threads=1), lidar, MIDDLE), GRID, origin)
    looked = posterior.Looked.of(MIDDLE, lidar, GRID, origin, marked.observed, marked.free)
    return looked, world.clear()


def chains(posterior, lidar, count, origin=ORIGIN):
    """Chains that begin with worlds of the prior which keep clear of the sensor."""
    rng, prior = np.random.default_rng(5), posterior.prior_of(TOY, CLEAR_M)
    while count:
        numbers = posterior.numbers_of(TOY, rng)
        looked, clear = seen(posterior, numbers, lidar, origin)
        if clear:
            count -= 1
            yield posterior.Chain(looked, prior, numbers, count)


def figures(posterior, chain):
    """Figures of a world whose means tell one law from another."""
    p = posterior
    numbers, forms = chain.world()
    joined = numbers[:, p.PASSAGE] > 0
    away = np.hypot(forms[:, p.AT_X] - 3.0, forms[:, p.AT_Y] - 2.5)
    several = len(numbers), joined.sum(), (forms[:, p.SHAPE] == 1).sum()
    columns = numbers[:, [p.SECTION, p.HALF, p.RATIO, p.YAW]]
    sums = *columns.sum(axis=0), *(columns**2).sum(axis=0), away.sum(), (away**2).sum()
    loose = numbers[~joined][:, [p.X, p.Y]]
    passages = numbers[joined][:, [p.PARENT, p.ANGLE, p.GAP]]
    reach = (forms[:, p.HULL] * joined).sum()
    halves = (numbers[:, p.HALF] * away).sum()
    return *several, *sums, *loose.sum(axis=0), *passages.sum(axis=0), reach, halves


def assert_no_more_than_chance(means, errors):
    """Means (figures,) are 0, but for chance."""
    off = np.abs(means) / np.maximum(errors, 1e-9)
    assert off.max() < 4.5, off.round(1)


@pytest.mark.parametrize(
    ("lidar", "origin", "chances", "steps"),
    [
        (AROUND, ORIGIN, None, 150),
        (AROUND, BESIDE, [0.05, 0.05, 0.9, 0.0, 0.0, 0.0, 0.0], 60),
        (AROUND, BESIDE, [0.05, 0.45, 0.0, 0.0, 0.0, 0.3, 0.2], 150),
        (DOWN, ORIGIN, [0.05, 0.05, 0.0, 0.5, 0.4, 0.0, 0.0], 60),
        (DOWN, ORIGIN, [0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.98], 60),
        (DOWN, ORIGIN, [0.0, 0.0, 0.0, 0.2, 0.0, 0.8, 0.0], 100),
    ],
)
def test_worlds_of_the_prior_that_are_replaced_are_of_the_prior(
    posterior, lidar, origin, chances, steps
):
    # a world is drawn, looked at, and replaced by one that looks the same (Geweke 2004)
    begun, replaced = [], []
    for chain in chains(posterior, lidar, 3000, origin):
        assert chain.wrong == 0
        if chances is not None:
            chain.chances = np.cumsum(chances)
        begun.append(figures(posterior, chain))
        chain.walk(steps)
        replaced.append(figures(posterior, chain))
    change = np.subtract(replaced, begun)
    assert (change != 0).any(axis=1).mean() > 0.8
    assert_no_more_than_chance(change.mean(axis=0), change.std(axis=0) / len(change) ** 0.5)


def test_a_chain_and_rejection_sampling_agree(posterior):
    several = chains(posterior, AROUND, 100)
    chain = next(one for one in several if (one.looked.state == 2).sum() == 2)
    rng, kept, found = np.random.default_rng(8), [], []
    while len(kept) < 250:
        numbers = posterior.numbers_of(TOY, rng)
        other = posterior.Chain(chain.looked, chain.prior, numbers, 0)
        if other.wrong == 0 and other.clear():
            looked, _ = seen(posterior, numbers, AROUND)
            assert looked.state.tolist() == chain.looked.state.tolist()
            kept.append(figures(posterior, other))
    for _ in range(2000):
        chain.walk(200)
        found.append(figures(posterior, chain))
    first, second = np.array(kept), np.array(found)
    variance = (
        first.var(axis=0) / len(kept) + second.var(axis=0) / 1000
    )  # less than all are independent
    assert_no_more_than_chance(first.mean(axis=0) - second.mean(axis=0), np.sqrt(variance))
