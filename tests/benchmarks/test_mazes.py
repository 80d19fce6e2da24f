"""Chains of mazes that look the same: their laws are the prior's, given what was seen."""

import importlib

import numpy as np
import pytest

from lidarsim import AnalyticEngine, GridSpec, Lidar, Pose, cast, voxelize
from scenegen.worlds.kinds.maze import Maze
from tests.benchmarks.test_posterior import assert_no_more_than_chance
from tests.command_line import ROOT

pytestmark = pytest.mark.slow
TOY = Maze(size_m=(9.0, 9.0, 6.6), cell_m=(4.0, 4.4), level_m=(3.0, 3.2), shelf_share=0.5)
"""Two cells along every axis, and twelve walls."""
INSIDE = Pose(np.array([2.2, 2.2, 1.5]), np.array([1.0, 0.0, 0.0, 0.0]))
GRID = GridSpec(shape=(4, 4, 2), voxel_m=2.0, truncation_m=3.0)
ORIGIN = GRID.origin_at(INSIDE.position)
BESIDE = ORIGIN + 100.0
"""Of a grid that no ray reaches: every maze looks the same."""
CLEAR_M = 0.3
AROUND = Lidar(rows=2, columns=6, pitch_deg=10.0, vertical_fov_deg=60.0, max_range_m=6.0)


@pytest.fixture
def mazes(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("mazes")


def seen(mazes, numbers, origin=ORIGIN):
    """What the library's own rays and voxels see of a maze."""
    nothing = np.zeros(GRID.shape, bool)
    blind = mazes.Looked.of(INSIDE, AROUND, GRID, origin, nothing, nothing)
    world = mazes.Chain(blind, mazes.prior_of(TOY, CLEAR_M), numbers, 0)
    floor = [4.5, 4.5, -0.1, 4.5, 4.5, 0.1]
    solids = mazes.solids_of(np.concatenate([[floor], world.world()[1]]))
    marked = voxelize(cast(AnalyticEngine(solids, threads=1), AROUND, INSIDE), GRID, origin)
    looked = mazes.Looked.of(INSIDE, AROUND, GRID, origin, marked.observed, marked.free)
    return looked, world.clear()


def chains(mazes, count, origin=ORIGIN):
    """Chains that begin with mazes of the prior which keep clear of the sensor."""
    rng, prior = np.random.default_rng(5), mazes.prior_of(TOY, CLEAR_M)
    while count:
        numbers = mazes.numbers_of(TOY, rng)
        looked, clear = seen(mazes, numbers, origin)
        if clear:
            count -= 1
            yield mazes.Chain(looked, prior, numbers, count)


def figures(chain):
    """Figures of a maze whose means tell one law from another."""
    numbers, boxes = chain.world()
    joined = chain.joined()
    places = np.argsort(numbers.order)
    of_walls = np.array([joined, places, *numbers.chances.T])
    sums = *of_walls.sum(axis=1), *(of_walls**2).sum(axis=1), *(of_walls * joined).sum(axis=1)
    by_wall = *joined, *(places - 5.5)
    volume = 8 * boxes[:, 3:].prod(axis=1).sum()
    return *sums, *by_wall, len(boxes), volume, numbers.half[0], numbers.half[0] * joined.sum()


@pytest.mark.parametrize(
    ("origin", "chances", "steps"),
    [
        (ORIGIN, None, 150),
        (BESIDE, [0.3, 0.3, 0.3, 0.0, 0.0, 0.1], 60),
        (BESIDE, [0.0, 0.0, 0.0, 0.5, 0.5, 0.0], 60),
    ],
)
def test_mazes_of_the_prior_that_are_replaced_are_of_the_prior(mazes, origin, chances, steps):
    # a maze is drawn, looked at, and replaced by one that looks the same (Geweke 2004)
    begun, replaced = [], []
    for chain in chains(mazes, 3000, origin):
        assert chain.wrong == 0
        if chances is not None:
            chain.chances = np.cumsum(chances)
        begun.append(figures(chain))
        chain.walk(steps)
        replaced.append(figures(chain))
    change = np.subtract(replaced, begun)
    assert (change != 0).any(axis=1).mean() > 0.8
    assert_no_more_than_chance(change.mean(axis=0), change.std(axis=0) / len(change) ** 0.5)


def test_a_chain_and_rejection_sampling_agree(mazes):
    chain = next(one for one in chains(mazes, 1))
    rng, kept, found = np.random.default_rng(8), [], []
    while len(kept) < 250:
        numbers = mazes.numbers_of(TOY, rng)
        other = mazes.Chain(chain.looked, chain.prior, numbers, 0)
        if other.wrong == 0 and other.clear():
            looked, _ = seen(mazes, numbers)
            assert looked.state.tolist() == chain.looked.state.tolist()
            kept.append(figures(other))
    for _ in range(2000):
        chain.walk(200)
        found.append(figures(chain))
    first, second = np.array(kept), np.array(found)
    variance = first.var(axis=0) / len(kept) + second.var(axis=0) / 1000
    assert_no_more_than_chance(first.mean(axis=0) - second.mean(axis=0), np.sqrt(variance))
