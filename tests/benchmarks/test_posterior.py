"""Chains of worlds that look the same: their laws are the prior's, given what was seen."""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from lidarsim import AnalyticEngine, GridSpec, Lidar, Pose, cast, voxelize
from scenegen.worlds.kinds.maze import Maze
from scenegen.worlds.kinds.pillar import Pillar
from tests.command_line import ROOT

pytestmark = pytest.mark.slow
CLEAR_M = 0.3


class Toy(NamedTuple):
    """A small recipe, and what looks at its worlds."""

    sampler: str
    kind: Any
    position: tuple[float, float, float]
    grid: GridSpec
    lidars: tuple[Lidar, ...]
    solids: Callable[..., Any]
    """From the sampler and a chain to the solids of its world."""
    figures: Callable[..., Any]
    """From the sampler and a chain to figures whose means tell one law from another."""


def pillars_of(p, chain):
    return p.solids_of(*chain.world(), chain.prior[p.HEIGHT])


def pillars_told(p, chain):
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


def maze_of(mazes, chain):
    floor = [4.5, 4.5, -0.1, 4.5, 4.5, 0.1]
    return mazes.solids_of(np.concatenate([[floor], chain.world()[1]]))


def maze_told(mazes, chain):
    numbers, boxes = chain.world()
    joined, places = chain.joined(), np.argsort(numbers.order)
    of_walls = np.array([joined, places, *numbers.chances.T])
    sums = *of_walls.sum(axis=1), *(of_walls**2).sum(axis=1), *(of_walls * joined).sum(axis=1)
    volume, half = boxes[:, 3:].prod(axis=1).sum(), numbers.half[0]
    return *sums, *joined, *(places - 5.5), len(boxes), volume, half, half * joined.sum()


TOYS = {
    "pillar": Toy(  # three to six pillars
        "posterior",
        Pillar(
            size_m=(6.0, 5.0, 10.0),
            density=(0.1, 0.2),
            half_width_m=(0.1, 1.0),
            passage_share=0.3,
            passage_m=(0.2, 3.0),
        ),
        (3.0, 2.5, 4.0),
        GridSpec(shape=(4, 4, 2), voxel_m=1.5, truncation_m=3.0),
        (
            Lidar(rows=1, columns=6, pitch_deg=0.0, vertical_fov_deg=1.0, max_range_m=4.0),
            # it sees nothing but what is below it, where no pillar is
            Lidar(rows=1, columns=1, pitch_deg=90.0, vertical_fov_deg=1.0, max_range_m=4.0),
        ),
        pillars_of,
        pillars_told,
    ),
    "maze": Toy(  # two cells along every axis, and twelve walls
        "mazes",
        Maze(size_m=(9.0, 9.0, 6.6), cell_m=(4.0, 4.4), level_m=(3.0, 3.2), shelf_share=0.5),
        (2.2, 2.2, 1.5),
        GridSpec(shape=(4, 4, 2), voxel_m=2.0, truncation_m=3.0),
        (Lidar(rows=2, columns=6, pitch_deg=10.0, vertical_fov_deg=60.0, max_range_m=6.0),),
        maze_of,
        maze_told,
    ),
}


@pytest.fixture
def sampler(monkeypatch, kind):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module(TOYS[kind].sampler)


def seen(toy, sampler, numbers, lidar, away=0.0):
    """What the library's own rays and voxels see of a world, in a grid that is so far away."""
    pose, nothing = Pose.level(toy.position, 0.0), np.zeros(toy.grid.shape, bool)
    origin = toy.grid.origin_at(pose.position) + away
    blind = sampler.Looked.of(pose, lidar, toy.grid, origin, nothing, nothing)
    world = sampler.Chain(blind, sampler.prior_of(toy.kind, CLEAR_M), numbers, 0)
    engine = AnalyticEngine(toy.solids(sampler, world), threads=1)
    marked = voxelize(cast(engine, lidar, pose), toy.grid, origin)
    looked = sampler.Looked.of(pose, lidar, toy.grid, origin, marked.observed, marked.free)
    return looked, world.clear()


def chains(toy, sampler, lidar, count, away=0.0):
    """Chains that begin with worlds of the prior which keep clear of the sensor."""
    rng, prior = np.random.default_rng(5), sampler.prior_of(toy.kind, CLEAR_M)
    while count:
        numbers = sampler.numbers_of(toy.kind, rng)
        looked, clear = seen(toy, sampler, numbers, lidar, away)
        if clear:
            count -= 1
            yield sampler.Chain(looked, prior, numbers, count)


def assert_no_more_than_chance(means, errors):
    """Means (figures,) are 0, but for chance."""
    off = np.abs(means) / np.maximum(errors, 1e-9)
    assert off.max() < 4.5, off.round(1)


@pytest.mark.parametrize(
    ("kind", "lidar", "away", "chances", "steps"),
    [
        # far from the grid, pillars return rays, and every world looks the same
        ("pillar", 0, 0.0, None, 150),
        ("pillar", 0, 100.0, [0.05, 0.05, 0.9], 60),
        ("pillar", 0, 100.0, [0.05, 0.45, 0.0, 0.0, 0.0, 0.3, 0.2], 150),
        ("pillar", 1, 0.0, [0.05, 0.05, 0.0, 0.5, 0.4], 60),
        ("pillar", 1, 0.0, [0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.98], 60),
        ("pillar", 1, 0.0, [0.0, 0.0, 0.0, 0.2, 0.0, 0.8], 100),
        ("maze", 0, 0.0, None, 150),
        ("maze", 0, 100.0, [0.3, 0.3, 0.3, 0.0, 0.0, 0.1], 60),
        ("maze", 0, 100.0, [0.0, 0.0, 0.0, 0.5, 0.5], 60),
    ],
)
def test_worlds_of_the_prior_that_are_replaced_are_of_the_prior(
    sampler, kind, lidar, away, chances, steps
):
    # a world is drawn, looked at, and replaced by one that looks the same (Geweke 2004)
    toy, begun, replaced = TOYS[kind], [], []
    for chain in chains(toy, sampler, toy.lidars[lidar], 3000, away):
        assert chain.wrong == 0
        if chances is not None:
            chain.chances = np.cumsum(chances)
        begun.append(toy.figures(sampler, chain))
        chain.walk(steps)
        replaced.append(toy.figures(sampler, chain))
    change = np.subtract(replaced, begun)
    assert (change != 0).any(axis=1).mean() > 0.8
    assert_no_more_than_chance(change.mean(axis=0), change.std(axis=0) / len(change) ** 0.5)


@pytest.mark.parametrize("kind", TOYS)
def test_a_chain_and_rejection_sampling_agree(sampler, kind):
    toy = TOYS[kind]
    lidar = toy.lidars[0]
    several = chains(toy, sampler, lidar, 100)
    chain = next(one for one in several if (one.looked.state == 2).sum() >= 2)
    rng, kept, found = np.random.default_rng(8), [], []
    while len(kept) < 250:
        numbers = sampler.numbers_of(toy.kind, rng)
        other = sampler.Chain(chain.looked, chain.prior, numbers, 0)
        if other.wrong == 0 and other.clear():
            looked, _ = seen(toy, sampler, numbers, lidar)
            assert looked.state.tolist() == chain.looked.state.tolist()
            kept.append(toy.figures(sampler, other))
    for _ in range(2000):
        chain.walk(200)
        found.append(toy.figures(sampler, chain))
    first, second = np.array(kept), np.array(found)
    # less than all of the chain's worlds are independent
    variance = first.var(axis=0) / len(kept) + second.var(axis=0) / 1000
    assert_no_more_than_chance(first.mean(axis=0) - second.mean(axis=0), np.sqrt(variance))
