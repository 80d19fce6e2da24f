"""What a sample of each family of sensors costs, and what several scans add: CPU time, in turn.

python benchmarks/sensors.py --kind pillar --samples 20 --rounds 3
python benchmarks/sensors.py --only default scan --samples 100 --rounds 5
"""

import math
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import measuring

from scenegen.dataset.generation import plan_generation

SENSORS = ("velodyne-vlp-16", "ouster-os1-64", "livox-mid-360", "livox-avia", "realsense-d435")
DATASETS: dict[str, dict[str, Any]] = {
    "default": {},
    **{name: {"lidar": name} for name in SENSORS},
    "5 scans": {"mapping": {"scans": 5}},
    "5 scans, log-odds": {"mapping": {"scans": 5, "fusion": "log-odds"}},
    "1 scan, leaning": {"mapping": {"tilt_mps": 2.0}},
    "1 scan, map ahead": {"mapping": {"map_ahead_m": (8.0, 0.0, 0.0)}},
}
"""What is asked of `scenegen.generate`."""


class Options(measuring.Options):
    """What is measured."""

    kind: str = "pillar"
    samples: int = 20
    rounds: int = 3
    only: Sequence[str] = ("",)
    """rows whose names hold this word"""


def main() -> None:
    """Measure and print."""
    given = measuring.parse(Options, samples=5, rounds=1, only=["default", "avia", "ahead"])
    shards: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, asked in DATASETS.items():
            if any(word in name for word in given.only):
                more = {"out": folder, "shard_samples": given.samples, **asked}
                (plan,) = plan_generation(given.kind, given.samples, val=0, test=0, **more).datasets
                shards[name] = plan.shards[0]
        tasks = {name: partial(shard.write, Path(folder)) for name, shard in shards.items()}
        times = measuring.in_turn(tasks, given.rounds)
    for name, shard in shards.items():
        milliseconds = times[name].processor / given.samples
        rays = shard.recipe.mapping.scans * math.prod(shard.recipe.lidar.shape)
        print(
            f"{name:24} {milliseconds:9.2f} ms a sample  {rays:7} rays  "
            f"{1e3 * milliseconds / rays:7.3f} us a ray"
        )


if __name__ == "__main__":
    main()
