"""Scans of a world: clean ones, what noise makes of them, and one by itself."""

from collections.abc import Sequence

import numpy as np

from lidarsim import AnalyticEngine, Engine, Pose, Scan, Sensor, cast
from lidarsim.engines import EngineFactory
from lidarsim.noise.chain import Noise
from lidarsim.noise.returns import Returns, albedo_of
from scenegen import SPLITS
from scenegen.errors import GenerationError
from scenegen.worlds.world import World

STREAM = 2
"""The streams 0 and 1 of a draw are its world's and its flight's, see `scenegen.draw`."""


def scan_world(
    world: World,
    lidar: Sensor,
    pose: Pose,
    noise: Noise | None = None,
    *,
    seed: int | Sequence[int],
    engine: EngineFactory = AnalyticEngine.of,
) -> Returns:
    """What a sensor returns of a world.

    Args:
        world: The world.
        lidar: The sensor.
        pose: The pose of the body that holds the sensor.
        noise: What becomes of the clean ranges; nothing by default.
        seed: What the noise is drawn by.
        engine: What casts the rays.

    Raises:
        GenerationError: A stage of the noise needs what the engine does not know.
    """
    caster = engine(world.model, world.data)
    rng = np.random.default_rng(seed)
    return _observed(cast(caster, lidar, pose), noise or Noise(), world, caster, rng)


def scans_from(poses: Sequence[Pose], engine: Engine, lidar: Sensor) -> list[Scan]:
    """The clean scans of `lidar` from `poses`. Raises GenerationError where the engine fails."""
    try:
        return [cast(engine, lidar, pose) for pose in poses]
    except ValueError as error:
        raise GenerationError(f"the engine fails: {error}") from None


def with_noise(
    scans: Sequence[Scan],
    noise: Noise,
    world: World,
    engine: Engine,
    *,
    seed: int,
    split: str,
    unit: int,
    view: int,
) -> list[Scan]:
    """The scans of view `view` of a unit as the sensor has them: the view's own, and those before
    it, the last one first.

    The noise is drawn by the sample's own place and the seed alone, not by the draw that was kept:
    what is scanned again from the same pose has the same noise. Without stages, the scans are
    `scans` themselves. Raises GenerationError where a stage fails, or gives what a dataset's
    `ranges` cannot hold: several echoes, intensities, or returns told to lie elsewhere than along
    the rays.
    """
    if not noise.stages:
        return list(scans)
    found = []
    for before, scan in enumerate(scans):
        key = (SPLITS.index(split), unit, 0, STREAM, view, *([before] if before else []))
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
        seen = _observed(scan, noise, world, engine, rng)
        if len(seen.ranges) > 1 or seen.intensity is not None:
            raise GenerationError(
                f"noise {noise}: a dataset holds one range a ray and nothing else; leave intensity "
                "out, and two returns"
            )
        moved = (seen.told_origins != scan.pose.position).any()
        if moved or not np.array_equal(seen.told_directions, scan.directions):
            raise GenerationError(
                f"noise {noise}: a dataset's rays begin where the scan does; leave corrected "
                "motion out, or use `scan`"
            )
        found.append(Scan(seen.ranges[0].astype(np.float32), scan.pose, scan.lidar))
    return found


def _observed(
    scan: Scan, noise: Noise, world: World, engine: Engine, rng: np.random.Generator
) -> Returns:
    try:
        return noise.observe(scan, engine, rng=rng, albedo=albedo_of(world.model))
    except ValueError as error:
        raise GenerationError(str(error)) from None
