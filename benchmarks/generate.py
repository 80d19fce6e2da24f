"""What a sample costs: milliseconds per stage, samples per second and core, memory and size; then whole runs.

    python benchmarks/generate.py [--kind pillar] [--seconds 10] [--runs] [--plot stages.png]

The stages are those of the real pipeline, timed where it calls them. Two have a baseline in the same run: scipy's exact
distance transform, and zlib at the same level. `--runs` also times `scenegen generate --n 2500` on all cores.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import zlib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bars import draw
from scipy import ndimage

import scenegen.dataset.shard as shard_module
import scenegen.draw as draw_module
import scenegen.source as source_module
import scenegen.world as world_module
from scenegen.dataset.build import plan_dataset
from scenegen.recipe import preset
from scenegen.recipes import kind_names
from scenegen.sample import Sample
from scenegen.source import DrawnWorlds
from scenegen.truth import distance_field

STAGES: dict[str, tuple[Any, str]] = {
    "draw world, write MJCF, compile": (source_module, "write_world"),
    "  of which compile, read solids": (world_module, "compile_world"),
    "plan flight": (draw_module, "plan"),
    "make engine": (draw_module, "engine_of"),
    "cast rays": (draw_module, "cast"),
    "occupancy": (draw_module, "rasterize"),
    "observed and free": (draw_module, "voxelize"),
    "distance": (draw_module, "distance_field"),
    "compress": (shard_module, "compress"),
    "sample digest": (Sample, "sha256"),
    "file digest": (shard_module, "file_digest"),
    "write and sync": (shard_module, "write_whole"),
}


class Stopwatch:
    """Seconds spent in each stage, by standing in for the function that the pipeline calls."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        for name, (owner, attribute) in STAGES.items():
            setattr(owner, attribute, self._timed(name, getattr(owner, attribute)))

    def _timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            begin = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds[name] += time.perf_counter() - begin

        return timed


def measure(kind: str, seconds: float, watch: Stopwatch) -> dict[str, float]:
    """Write shards in this process for `seconds`, print what they took, and return the milliseconds of each stage."""
    recipe = preset(kind)
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
        plan = plan_dataset(
            Path(folder), recipe, DrawnWorlds(recipe), seed=0, counts={"train": 100_000, "val": 0, "test": 0}
        )
        shard_module.write_shard(plan.shards[0])  # kernels compile, caches fill
        watch.seconds.clear()
        begin, samples, size = time.perf_counter(), 0, 0
        for shard in plan.shards[1:]:
            report = shard_module.write_shard(shard)
            samples, size = samples + report.samples, size + report.size
            if time.perf_counter() - begin > seconds:
                break
        spent = time.perf_counter() - begin
    print(
        f"\n{kind}: {samples / spent:.0f} samples a second and core, {spent / samples * 1e3:.2f} ms a sample, ", end=""
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{size / samples / 1e3:.1f} KB a sample, peak memory {peak:.0f} MB")
    stages = {name: watch.seconds[name] / samples * 1e3 for name in STAGES}
    whole = {name: ms for name, ms in stages.items() if not name.startswith("  ")}
    whole["everything else"] = spent / samples * 1e3 - sum(whole.values())
    for name, ms in (stages | whole).items():
        print(f"  {name:34} {ms:6.3f} ms")
    _baselines(kind)
    return whole


def _baselines(kind: str) -> None:
    """The two stages that a library also has, on the same maps."""
    recipe = preset(kind)
    units = [
        draw_module.draw_unit(DrawnWorlds(recipe), recipe, seed=0, split="train", unit=unit).samples
        for unit in range(8)
    ]
    samples = [sample for unit in units for sample in unit]

    def ms(function: Callable[[Any], Any]) -> float:
        begin = time.perf_counter()
        for sample in samples:
            function(sample)
        return (time.perf_counter() - begin) / len(samples) * 1e3

    ours = ms(lambda sample: distance_field(sample.occupancy, recipe.grid))
    scipys = ms(lambda sample: ndimage.distance_transform_edt(~sample.occupancy))
    print(f"  distance transform: {ours:.2f} ms, scipy's {scipys:.2f} ms, {scipys / ours:.0f} times as long")
    ours = ms(lambda sample: shard_module.compress(sample.tudf))
    zlibs = ms(lambda sample: zlib.compress(sample.tudf.tobytes(), 1))
    print(f"  compressing distances: {ours:.2f} ms, zlib's {zlibs:.2f} ms, {zlibs / ours:.0f} times as long")


def time_runs(kind: str) -> None:
    """Whole commands on all cores: full and compact, each with its own start-up and its workers' memory."""
    for flags in ((), ("--compact",)):
        folder = Path(tempfile.mkdtemp(dir=Path.cwd()))
        try:
            begin = time.perf_counter()
            command = [
                sys.executable,
                "-m",
                "cli",
                "generate",
                "--kind",
                kind,
                "--n",
                "2500",
                "--out",
                str(folder),
                "--json",
            ]
            ran = subprocess.run([*command, *flags], cwd=Path(__file__).parents[1], capture_output=True, check=True)
            spent = time.perf_counter() - begin
            said = json.loads(ran.stdout)
            count = sum(said["samples"].values())
            peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
            print(
                f"{kind} --n 2500 {' '.join(flags)}: {count} samples in {spent:.1f} s on {os.cpu_count()} cores, "
                f"{said['bytes'] / count / 1e3:.1f} KB a sample, largest process {peak:.0f} MB"
            )
        finally:
            shutil.rmtree(folder)


def main() -> None:
    """Parse and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=kind_names(), help="one kind instead of all")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to measure each kind")
    parser.add_argument("--runs", action="store_true", help="also time whole runs of 2500 training samples")
    parser.add_argument("--plot", type=Path, help="a picture of the stages, PNG")
    options = parser.parse_args()
    kinds = [options.kind] if options.kind else kind_names()
    watch = Stopwatch()
    rows = {kind: measure(kind, options.seconds, watch) for kind in kinds}
    if options.plot:
        draw(options.plot, rows, "What a sample takes, one core", stacked=True)
    if options.runs:
        print()
        for kind in kinds:
            time_runs(kind)


if __name__ == "__main__":
    main()
