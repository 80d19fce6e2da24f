"""One scan of one world, with or without noise: what `scenegen scan` does, and Python in a few
lines.

world = read_world(Path("scenes/warehouse.xml"))
seen = scan_world(world, VLP_16, Pose.level((8.0, 6.0, 1.5)), Noise.parse("range:0.02"), seed=0)
print(seen.points().shape)
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarsim import AnalyticEngine, Pose, Sensor, cast
from lidarsim.engines import EngineFactory
from lidarsim.noise.chain import Noise
from lidarsim.noise.returns import Returns, albedo_of
from scenegen.errors import GenerationError, SceneError
from scenegen.source import read_scenes
from scenegen.worlds.flight import Flight, Viewpoints, plan, viewpoints
from scenegen.worlds.world import World

TRIES = 50
"""Flights tried before a world counts as too narrow."""


def read_world(path: Path) -> World:
    """The world of an MJCF file. Raises SceneError for one that cannot serve."""
    if path.is_dir():
        raise SceneError(f"{path}: is a folder; expected one MJCF file")
    source = read_scenes(path, {"train": 1, "val": 0, "test": 0}, seed=0, allow_unseen=True)
    return source.world("train", 0, rng=np.random.default_rng(0))


def pose_in_flight(world: World, *, seed: int, flight: Flight | None = None) -> Pose:
    """A random viewpoint of a random flight through the world. Raises GenerationError where none
    fits."""
    return _flown(world, flight or Flight(), seed).pose(0)


def poses_in_flight(
    world: World, *, seed: int, every_m: float | None = None, flight: Flight | None = None
) -> list[Pose]:
    """The viewpoints of a random flight through the world, every `every_m` metres (the flight's own
    spacing unless given), in the order in which they are passed. Raises GenerationError where none
    fits."""
    flight = flight or Flight()
    found = _flown(world, dataclasses.replace(flight, spacing_m=every_m or flight.spacing_m), seed)
    return [found.pose(int(n)) for n in np.argsort(found.flown_m)]


def _flown(world: World, flight: Flight, seed: int) -> Viewpoints:
    rng = np.random.default_rng(seed)
    for _ in range(TRIES):
        path = plan(world.clearance, world.flight_bounds, flight, rng=rng)
        if path is not None and len(found := viewpoints(path, flight.spacing_m, rng=rng)):
            return found
    raise GenerationError(f"no flight fits between the solids in {TRIES} tries; give --pose")


def scan_world(
    world: World,
    lidar: Sensor,
    pose: Pose,
    noise: Noise | None = None,
    *,
    seed: int | Sequence[int],
    engine: EngineFactory = AnalyticEngine.of,
) -> Returns:
    """What `lidar` on a body at `pose` returns of the world; the noise is drawn by `seed`.

    Raises GenerationError where a stage needs what the engine does not know.
    """
    caster = engine(world.model, world.data)
    clean = cast(caster, lidar, pose)
    try:
        return (noise or Noise()).observe(
            clean, caster, rng=np.random.default_rng(seed), albedo=albedo_of(world.model)
        )
    except ValueError as error:
        raise GenerationError(str(error)) from None
