"""What movers add to a scan and to a dataset, how often rays of two engines disagree, and which
movers `ingest` takes out of the maps of logs.

    python benchmarks/movers.py [--kinds pillar street] [--worlds 5] [--samples 300] [--logs 12]

Times are processor time, the least of all rounds; a ratio has the standing world in both. Logs are
recorded with `--movers dense` and without noise, all rays of a scan at once, so the truth is exact:
an observed voxel is of a mover if no solid that stands touches it. Figures of logs are means over
worlds, with 95 % intervals; `every miss` is the rule before misses beside a return were left out.
"""

import itertools
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import measuring
import numpy as np

from lidarsim import AnalyticEngine, GridSpec, MujocoEngine, Pose, cast
from lidarsim.engines.voxels import OCCUPIED
from lidarsim.grid import Floats, Mask
from lidarsim.noise.chain import Noise
from scenegen.dataset.generation import plan_generation
from scenegen.draw.source import DrawnWorlds, named_world
from scenegen.logs import Cruise, Fusing, fuse
from scenegen.logs.record import cruise_poses, out_of_the_way, period_s, record
from scenegen.model.bench.statistics import summarise
from scenegen.verification.rays import MovingAuditor
from scenegen.worlds.recipe import preset
from scenegen.worlds.tables import named_lidar
from scenegen.worlds.traffic import Traffic
from scenegen.worlds.world import World, with_movers

TEN = Traffic(people=(6, 6), vehicles=(0, 2), drones=(3, 3))
"""Ten movers, or one less or more."""
FIRING = "each ray at its own time"
TOLERANCE_M = 1e-6
SHARES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5)
"""Values of --moved-share."""
RULES = {"every miss": np.zeros((1, 3), int), "clear misses": fuse.AROUND}
"""Around an observed voxel, where misses do not count: `scenegen.logs.fuse.AROUND`."""
FIGURES = (
    "voxel precision",
    "voxel recall",
    "standing voxels lost",
    "point precision",
    "point recall",
)


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
    logs: int = 12
    """worlds of each kind in which a log is recorded and ingested"""
    length: float = 30.0
    """of a log's flight, metres"""
    lidar: str = "ouster-os1-64"
    """that records logs"""


def main() -> None:
    """Measure and print."""
    given = measuring.parse(
        Options,
        kinds=["pillar"],
        worlds=1,
        rays=500,
        samples=5,
        rounds=1,
        logs=2,
        length=2.0,
        lidar="velodyne-vlp-16",
    )
    for kind in given.kinds:
        ingested(kind, given)
        worlds = [moving(kind, seed) for seed in range(given.worlds)]
        scans(kind, worlds[0], given.rounds)
        wrong, met = np.sum([differing(world, given.rays) for world in worlds], axis=0)
        rays = given.rays * len(worlds)
        print(f"{kind}: {rays} rays, {met} on movers, {wrong} more than {TOLERANCE_M:g} m apart")
        generated(kind, given.samples, given.rounds)


def moving(kind: str, seed: int) -> World:
    """A world of a kind, with movers."""
    recipe = preset(kind)
    world = DrawnWorlds(recipe).world("train", 0, rng=np.random.default_rng(seed))
    zones = recipe.mover_zones(world.flight_bounds)
    return with_movers(world, zones, TEN, seed=[seed], name=kind)


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


def ingested(kind: str, given: Options) -> None:
    """Print how well maps of logs are freed of movers, by rule and share."""
    figures = [removed(kind, seed, given) for seed in range(given.logs)]
    for rule, share in figures[0] if figures else ():
        values = np.array([figure[rule, share] for figure in figures])
        rows = [summarise(column, np.arange(len(values)), "share") for column in values.T]
        cells = ", ".join(
            f"{name} {row['mean']:.4f} [{row['low']:.4f}, {row['high']:.4f}]"
            for name, row in zip(FIGURES, rows, strict=True)
            if row["low"] is not None  # nothing was removed in a short log
        )
        print(f"{kind}: {rule}, moved-share {share:g}: {cells}", flush=True)


def removed(kind: str, seed: int, given: Options) -> dict[tuple[str, float], list[float]]:
    """`FIGURES` of a world's log, by rule and share."""
    sensor, how = named_lidar(given.lidar), Fusing()
    world, every_s = named_world(kind, seed, movers="dense"), period_s(sensor)
    poses = cruise_poses(world, Cruise(length_m=given.length), every_s, seed=seed)
    moving = out_of_the_way(world, poses, every_s)
    places = np.array([pose.position for pose in poses])
    reach = np.array([how.reach_m, how.reach_m, how.rise_m])
    first = np.floor((places.min(axis=0) - reach) / how.voxel_m).astype(int)
    last = np.ceil((places.max(axis=0) + reach) / how.voxel_m).astype(int)
    grid = GridSpec(shape=tuple((last - first).tolist()), voxel_m=how.voxel_m)
    counts = {rule: np.zeros((2, *grid.shape), np.uint8) for rule in RULES}
    cells, on_mover = [], []
    for scan in record(moving, AnalyticEngine.of, sensor, poses, Noise(), seed=seed):
        corner, seen, points = fuse._window(scan, (scan.pose, 0.0), how)
        for rule, fuse.AROUND in RULES.items():
            fuse._count(counts[rule][0], counts[rule][1], corner - first, seen)
        index = grid.index(points + scan.pose.position, first * how.voxel_m)
        mapped = ((index >= 0) & (index < grid.shape)).all(axis=1)
        mapped &= (points**2).sum(axis=1) < how.reach_m**2
        cells.append(np.ravel_multi_index(tuple(index[mapped].T), grid.shape))
        on_mover.append(scan.more["mover"][mapped] > 0)
    cell, is_mover = np.concatenate(cells), np.concatenate(on_mover)
    standing = world.truth(grid, first * how.voxel_m)["occupancy"]
    figures = {}
    for (rule, (hits, misses)), share in itertools.product(counts.items(), SHARES):
        states = hits.copy()
        fuse._settle(states, misses, share)
        observed, gone = hits > 0, (hits > 0) & (states != OCCUPIED)
        taken = gone.reshape(-1)[cell]
        figures[rule, share] = [
            _share(gone & ~standing, gone),
            _share(gone & ~standing, observed & ~standing),
            _share(gone & standing, observed & standing),
            _share(taken & is_mover, taken),
            _share(taken & is_mover, is_mover),
        ]
    return figures


def _share(part: Mask, whole: Mask) -> float:
    """NaN, which counts in no mean, of nothing."""
    return np.count_nonzero(part) / (np.count_nonzero(whole) or np.nan)


if __name__ == "__main__":
    main()
