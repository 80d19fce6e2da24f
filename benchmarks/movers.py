"""What movers add to a scan and to a dataset, and how often rays of two engines disagree.

    python benchmarks/movers.py [--kinds pillar street] [--worlds 5] [--samples 300]

Times are processor time, the least of all rounds; a ratio has the standing world in both.
"""

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import measuring
import numpy as np

from lidarsim import AnalyticEngine, MujocoEngine, Pose, cast
from lidarsim.grid import Floats
from scenegen.dataset.generation import plan_generation
from scenegen.draw.source import DrawnWorlds
from scenegen.verification.rays import MovingAuditor
from scenegen.worlds.recipe import preset
from scenegen.worlds.traffic import Traffic
from scenegen.worlds.world import World, populated

TEN = Traffic(people=(6, 6), vehicles=(0, 2), drones=(3, 3))
"""Ten movers, or one less or more."""
FIRING = "each ray at its own time"
TOLERANCE_M = 1e-6


class Options(measuring.Options):
    """What is measured."""

    kinds: Sequence[str] = ("pillar", "street", "rooms")
    worlds: int = 5
    """of each kind, whose rays are compared"""
    rays: int = 20_000
    """in each world"""
    samples: int = 300
    """that are generated"""
    rounds: int = 5


def main() -> None:
    """Measure and print."""
    given = measuring.parse(Options, kinds=["pillar"], worlds=1, rays=500, samples=5, rounds=1)
    for kind in given.kinds:
        worlds = [moving(kind, seed) for seed in range(given.worlds)]
        scans(kind, worlds[0], given.rounds)
        wrong, met = np.sum([differing(world, given.rays) for world in worlds], axis=0)
        rays = given.rays * len(worlds)
        print(f"{kind}: {rays} rays, {met} on movers, {wrong} more than {TOLERANCE_M:g} m apart")
        generated(kind, given.samples, given.rounds)


def moving(kind: str, seed: int) -> World:
    """A world of a kind, with movers."""
    recipe = preset(kind)
    assert recipe.world is not None
    world = DrawnWorlds(recipe).world("train", 0, rng=np.random.default_rng(seed))
    zones, attempt = recipe.world.mover_zones(world.flight_bounds), 0
    while True:
        rng = np.random.default_rng([seed, attempt])
        if (found := populated(world, zones, TEN, rng=rng)) is not None:
            return found
        attempt += 1


def scans(kind: str, world: World, rounds: int) -> None:
    """Print what movers add to the paper's scan."""
    lidar, pose = preset(kind).lidar, Pose.level(world.flight_bounds.mean(axis=0))
    casters = {
        "standing": world.caster(AnalyticEngine.of),
        "moving": world.caster_at(AnalyticEngine.of, 3.0),
        FIRING: world.caster_at(
            AnalyticEngine.of, 3.0 + np.linspace(0, 0.1, lidar.shape[1]) + np.zeros(lidar.shape)
        ),
    }
    tasks = {name: partial(cast, caster, lidar, pose) for name, caster in casters.items()}
    times = measuring.in_turn(tasks, 20 * rounds, burst=5, of=min)
    base = times.pop("standing").processor
    count = 0 if world.movers is None else len(world.movers)
    for name, time in times.items():
        added = time.processor / base - 1.0
        print(f"{kind}: scan, {count} movers, {len(world.solids)} solids, {name}: +{added:.2f}")


def differing(world: World, rays: int) -> Floats:
    """Count rays that two engines have at other ranges, and those on movers."""
    rng = np.random.default_rng(0)
    origin = np.array([rng.uniform(*world.flight_bounds)])
    ways = rng.normal(size=(1, rays, 3))
    ways /= np.sqrt((ways * ways).sum(axis=-1, keepdims=True))
    # twenty times: MuJoCo places its bodies anew for each
    times_s = rng.choice(rng.uniform(0, 60, 20), rays)
    caster = world.caster_at(AnalyticEngine.of, times_s)
    ours, auditor = caster.cast(origin, ways, 30.0), MovingAuditor(world, MujocoEngine, times_s)
    gap = np.abs(np.minimum(ours, 30.0) - np.minimum(auditor.cast(origin, ways, 30.0), 30.0))
    standing = world.caster(AnalyticEngine.of).cast(origin, ways, 30.0)
    return np.array([np.count_nonzero(gap > TOLERANCE_M), np.count_nonzero(ours != standing)])


def generated(kind: str, samples: int, rounds: int) -> None:
    """Print how many samples a second and core are generated, as a share of the standing kind."""
    with tempfile.TemporaryDirectory() as folder:
        tasks = {}
        for name, movers in (("standing", None), ("light", "light")):
            place = Path(folder) / name
            place.mkdir()
            (plan,) = plan_generation(
                kind,
                samples,
                val=0,
                test=0,
                out=str(place),
                shard_samples=samples,
                movers=movers,
            ).datasets
            tasks[name] = partial(plan.shards[0].write, place)
        times = measuring.in_turn(tasks, rounds, of=min)
    share = times["standing"].processor / times["light"].processor
    print(f"{kind}: generate {samples} samples, light: {share:.2f} of the standing kind's pace")


if __name__ == "__main__":
    main()
