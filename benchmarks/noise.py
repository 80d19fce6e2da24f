"""What noise adds to a scan: the clean one and the noisy one in turn, in `scan`, `attach` and
`generate`, and stage by stage.

    python benchmarks/noise.py [--lidar ouster-os1-64] [--worlds pillar scenes/warehouse.xml]

Processor time, the least of all rounds; a ratio has the clean scan in both.
"""

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import measuring
import mujoco
import numpy as np

from lidarsim import Pose, Sensor, attach
from lidarsim.noise import STAGES
from lidarsim.noise.chain import DATASHEET
from scenegen.dataset.generation import plan_generation
from scenegen.draw.draw import scan_world
from scenegen.draw.source import named_world
from scenegen.worlds.kinds import kind_names
from scenegen.worlds.tables import named_lidar
from scenegen.worlds.world import World, solid

CLEAN = ""
Task = Callable[[], object]


class Options(measuring.Options):
    """What is measured."""

    lidar: str = "ouster-os1-64"
    worlds: Sequence[str] = ("pillar", "clutter", "rooms")
    """kinds, or files; only kinds are generated"""
    noises: Sequence[str] = (DATASHEET, *STAGES.builtin)
    """chains of stages; all are measured in `scan`, the first one in `attach` and `generate`"""
    samples: int = 10
    rounds: int = 7


def main() -> None:
    """Measure and print."""
    given = measuring.parse(
        Options, worlds=["pillar"], noises=[DATASHEET, "grazing"], samples=1, rounds=1
    )
    sensor = named_lidar(given.lidar)
    first = given.noises[0]
    for name in given.worlds:
        world = solid(named_world(name, 0), name)
        pose = Pose.level(world.flight_bounds.mean(axis=0))
        scan = partial(scan_world, world, sensor, pose, seed=0)
        report(
            f"{name}: scan",
            {noise: partial(scan, noise or None) for noise in ["", *given.noises]},
            given.rounds,
        )
        report(f"{name}: attach", attached(world, sensor, pose, first), given.rounds)
        if name in kind_names():
            with tempfile.TemporaryDirectory() as folder:
                tasks = {
                    noise: generated(name, given.lidar, noise, given.samples, folder)
                    for noise in (CLEAN, first)
                }
                report(f"{name}: generate {given.samples} samples", tasks, given.rounds)


def attached(world: World, sensor: Sensor, pose: Pose, noise: str) -> dict[str, Task]:
    """Scans of a sensor on a body of the world."""
    spec = mujoco.MjSpec.from_string(world.mjcf.decode(), assets=dict(world.assets))
    spec.worldbody.add_body(name="carrier", pos=pose.position)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mounted = attach(model, "carrier", sensor)
    return {
        CLEAN: lambda: mounted.scans(data),
        noise: lambda: mounted.observe(data, noise, rng=np.random.default_rng(0)),
    }


def generated(kind: str, lidar: str, noise: str, samples: int, folder: str) -> Task:
    """A shard of a dataset."""
    (plan,) = plan_generation(
        kind,
        samples,
        val=0,
        test=0,
        out=folder,
        lidar=lidar,
        noise=noise or None,
        shard_samples=samples,
    ).datasets
    return partial(plan.shards[0].write, Path(folder))


def report(title: str, tasks: dict[str, Task], rounds: int) -> None:
    """Measure tasks, the clean one first, and print what each takes, and how often the clean one
    would be done meanwhile."""
    times = measuring.in_turn(tasks, rounds, of=min)
    clean = times[CLEAN].processor
    for noise, took in times.items():
        ratio = took.processor / clean
        print(f"{title:30} {noise or 'clean':12} {took.processor:9.2f} ms {ratio:6.2f} times")


if __name__ == "__main__":
    main()
