"""What a sample of each family of sensors costs, and what noise, labels and several scans add: CPU
time, whole shards, interleaved.

    python benchmarks/sensors.py --kind pillar --samples 20 --rounds 3
    python benchmarks/sensors.py --only default --only scans --samples 100 --rounds 5
"""

import dataclasses
import math
import statistics
import tempfile
import time
from pathlib import Path

import measuring

from lidarsim.noise.chain import Noise
from lidarsim.sensors import SENSORS
from scenegen.dataset.build import plan_dataset
from scenegen.dataset.shard import write_shard
from scenegen.recipe import Recipe, preset
from scenegen.recipes import kind_names
from scenegen.source import DrawnWorlds
from scenegen.worlds.labels import labels_by
from scenegen.worlds.mapping import Mapper

SENSOR_NAMES = ("velodyne-vlp-16", "ouster-os1-64", "livox-mid-360", "livox-avia", "realsense-d435")
MAPPINGS = {
    "5 scans": Mapper(scans=5),
    "5 scans, log-odds": Mapper(scans=5, fusion="log-odds"),
    "1 scan, leaning": Mapper(tilt_mps=2.0),
    "1 scan, map ahead": Mapper(map_ahead_m=(8.0, 0.0, 0.0)),
}
CHAINS = ("range", "dropout", "divergence,range", "grazing", "faint")


def cost_ms(recipe: Recipe, samples: int) -> float:
    """CPU milliseconds a sample of a shard, drawn and written."""
    with tempfile.TemporaryDirectory() as folder:
        counts = {"train": samples, "val": 0, "test": 0}
        plan = plan_dataset(
            Path(folder), recipe, DrawnWorlds(recipe), seed=0, counts=counts, shard_samples=samples
        )
        begin = time.thread_time()
        write_shard(plan.shards[0])
        return 1e3 * (time.thread_time() - begin) / samples


def recipes(kind: str) -> dict[str, Recipe]:
    """What is measured, by name; the default first."""
    plain = preset(kind)
    sensors = {name: dataclasses.replace(plain, lidar=SENSORS.find(name)) for name in SENSOR_NAMES}
    noises = {
        f"noise {text}": dataclasses.replace(plain, noise=Noise.parse(text)) for text in CHAINS
    }
    labels = {"labels": dataclasses.replace(plain, labels=labels_by("name", ()))}
    mappings = {
        name: dataclasses.replace(plain, mapping=mapping) for name, mapping in MAPPINGS.items()
    }
    return {"default": plain, **sensors, **noises, **labels, **mappings}


def main() -> None:
    """Measure and print."""
    parser = measuring.options(__doc__)
    parser.add_argument("--kind", default="pillar", choices=kind_names())
    parser.add_argument("--samples", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--only", action="append", help="rows whose names hold this word; repeatable"
    )
    given = measuring.parse(
        parser, samples=5, rounds=1, only=["default", "avia", "grazing", "labels", "ahead"]
    )
    asked = {
        name: recipe
        for name, recipe in recipes(given.kind).items()
        if any(word in name for word in given.only or [""])
    }
    for recipe in asked.values():
        cost_ms(recipe, recipe.flight.viewpoints)  # compiles, where nothing is cached
    spent: dict[str, list[float]] = {name: [] for name in asked}
    for _ in range(given.rounds):
        for name, recipe in asked.items():
            spent[name].append(cost_ms(recipe, given.samples))
    for name, recipe in asked.items():
        milliseconds = statistics.median(spent[name])
        rays = recipe.mapping.scans * math.prod(recipe.lidar.shape)
        print(
            f"{name:24} {milliseconds:9.2f} ms a sample  {rays:7} rays  "
            f"{1e3 * milliseconds / rays:7.3f} us a ray"
        )


if __name__ == "__main__":
    main()
