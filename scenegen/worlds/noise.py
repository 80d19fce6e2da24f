"""The noise of a dataset: what becomes of a sample's clean ranges, by the sample's own place and
the seed alone."""

from collections.abc import Sequence

import numpy as np

from lidarsim import Engine, Scan
from lidarsim.noise.chain import Noise
from lidarsim.noise.returns import albedo_of
from scenegen import SPLITS
from scenegen.errors import GenerationError
from scenegen.worlds.world import World

STREAM = 2
"""The streams 0 and 1 of a draw are its world's and its flight's, see `scenegen.draw`."""


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
    """The clean scans of view `view` of unit `unit`, through `world`, as the sensor has them: the
    view's own, and those before it, the last one first. Without stages, they are `scans`
    themselves. Raises GenerationError."""
    place = (SPLITS.index(split), unit, 0, STREAM, view)
    places = (place, *((*place, before) for before in range(1, len(scans))))
    streams = [np.random.SeedSequence(seed, spawn_key=key) for key in places]
    return [
        _observed(scan, noise, world, engine, stream)
        for scan, stream in zip(scans, streams, strict=True)
    ]


def _observed(
    scan: Scan, noise: Noise, world: World, engine: Engine, stream: np.random.SeedSequence
) -> Scan:
    """One of them.

    Its stream belongs to the sample's place, not to the draw that was kept: what is scanned again
    from the same pose has the same noise. Raises GenerationError where a stage fails, or gives what
    a dataset's `ranges` cannot hold: several echoes, intensities, or returns told to lie elsewhere
    than along the rays.
    """
    if not noise.stages:
        return scan
    try:
        seen = noise.observe(
            scan, engine, rng=np.random.default_rng(stream), albedo=albedo_of(world.model)
        )
    except ValueError as error:
        raise GenerationError(str(error)) from None
    if len(seen.ranges) > 1 or seen.intensity is not None:
        raise GenerationError(
            f"noise {noise}: a dataset holds one range a ray and nothing else; leave intensity "
            f"out, and two returns"
        )
    if not (
        np.array_equal(
            seen.told_origins, np.broadcast_to(scan.pose.position, seen.told_origins.shape)
        )
        and np.array_equal(seen.told_directions, scan.directions)
    ):
        raise GenerationError(
            f"noise {noise}: a dataset's rays begin where the scan does; leave corrected motion "
            f"out, or use `scan`"
        )
    return Scan(seen.ranges[0].astype(np.float32), scan.pose, scan.lidar)
