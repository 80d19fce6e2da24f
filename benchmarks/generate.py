"""What a sample costs: milliseconds per stage, samples per second and core, memory and size; then
whole runs.

    python benchmarks/generate.py [--kind pillar] [--seconds 10] [--runs]

The stages are those of the real pipeline, timed where it calls them, by processor time, user's and
system's: that is what to compare on a machine that does other work. `--runs` also times the start
of a process, and `scenegen generate --n 2500` on all cores; whole commands and rates stand there by
the clock, too, which alone counts the waiting for the disk.
"""

import json
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import measuring

import scenegen.dataset.shard as shard_module
import scenegen.draw as draw_module
import scenegen.source as source_module
import scenegen.worlds.flight as flight_module
import scenegen.worlds.world as world_module
from scenegen.dataset.build import plan_dataset
from scenegen.recipe import preset
from scenegen.recipes import kind_names
from scenegen.run.workers import cores
from scenegen.sample import Sample
from scenegen.source import DrawnWorlds

STAGES: dict[str, tuple[Any, str]] = {
    "draw world, write MJCF, compile": (source_module, "write_world"),
    "  of which compile, read solids": (world_module, "compile_world"),
    "plan flight": (draw_module, "fly"),
    "  of which RRT": (flight_module, "connect"),
    "make engine": (world_module.World, "caster"),
    "cast rays": (draw_module, "cast"),
    "occupancy": (world_module, "rasterize"),
    "observed and free": (draw_module, "fuse"),
    "distance": (draw_module, "distance_field"),
    "compress": (shard_module, "compress"),
    "sample digest": (Sample, "sha256"),
    "file digest": (shard_module, "sha256_of"),
    "write and sync": (shard_module, "write_whole"),
}


@contextmanager
def stopwatch() -> Iterator[defaultdict[str, float]]:
    """Seconds of processor spent in each stage: what the pipeline calls is timed meanwhile."""
    seconds: defaultdict[str, float] = defaultdict(float)

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def stand_in(*args: Any, **kwargs: Any) -> Any:
            begin = time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                seconds[name] += time.process_time() - begin

        return stand_in

    with ExitStack() as stack:
        for name, (owner, attribute) in STAGES.items():
            stand_in = timed(name, getattr(owner, attribute))
            stack.enter_context(patch.object(owner, attribute, stand_in))
        yield seconds


def measure(kind: str, seconds: float) -> None:
    """Write shards in this process for `seconds`, and print what they and their stages took."""
    recipe = preset(kind)
    counts = {"train": 100_000, "val": 0, "test": 0}
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder, stopwatch() as spent:
        plan = plan_dataset(Path(folder), recipe, DrawnWorlds(recipe), seed=0, counts=counts)
        shard_module.write_shard(plan.shards[0])  # kernels compile, caches fill
        spent.clear()
        begin, used, samples, size = time.perf_counter(), measuring.processor_s(), 0, 0
        for shard in plan.shards[1:]:
            report = shard_module.write_shard(shard)
            samples, size = samples + report.samples, size + report.size
            if time.perf_counter() - begin > seconds:
                break
        wall, used = time.perf_counter() - begin, measuring.processor_s() - used
    if idle := STAGES.keys() - spent:
        sys.exit(f"{kind}: nothing was timed of {', '.join(sorted(idle))}; see STAGES")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"\n{kind}: {samples / wall:.0f} samples a second and core ({samples / used:.0f} by "
        f"processor time), "
        f"{wall / samples * 1e3:.2f} ms a sample ({used / samples * 1e3:.2f} of processor), "
        f"{size / samples / 1e3:.1f} KB a sample, peak memory {peak:.0f} MB"
    )
    stages = {name: spent[name] / samples * 1e3 for name in STAGES}
    whole = {name: ms for name, ms in stages.items() if not name.startswith("  ")}
    total = used / samples * 1e3
    whole["everything else"] = total - sum(whole.values())
    for name, ms in (stages | whole).items():
        print(f"  {name:34} {ms:6.3f} ms {ms / total:5.0%}")


def time_runs(kind: str, count: int) -> None:
    """Whole commands on all cores: full and compact, each with its own start-up and its workers'
    memory."""
    for flags in ((), ("--compact",)):
        with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
            words = f"generate --kind {kind} --n {count} --json --out".split()
            cost, printed = measuring.run("-m", "scenegen", *words, folder, *flags)
        said = json.loads(printed)
        made = sum(said["samples"].values())
        print(
            f"{' '.join((kind, '--n', str(count), *flags))}: {made} samples in {cost.wall_s:.1f} "
            f"s on {cores()} "
            f"cores, {cost.processor_s:.1f} s of processor, {said['bytes'] / made / 1e3:.1f} KB a "
            f"sample, "
            f"largest process {cost.megabytes:.0f} MB"
        )


def main() -> None:
    """Parse and measure."""
    parser = measuring.options(__doc__)
    parser.add_argument("--kind", choices=kind_names(), help="one kind instead of two")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to measure each kind")
    parser.add_argument("--runs", action="store_true", help="also time whole commands")
    parser.add_argument("--n", type=int, default=2500, help="training samples of a whole command")
    given = measuring.parse(parser, kind="pillar", seconds=0, runs=True, n=5)
    kinds = [given.kind] if given.kind else ["geometric", "pillar"]
    for kind in kinds:
        measure(kind, given.seconds)
    if given.runs:
        start = measuring.run("-m", "scenegen", "--version")[0]
        print(f"\nstart of a process: {start.processor_s:.2f} s of processor")
        for kind in kinds:
            time_runs(kind, given.n)


if __name__ == "__main__":
    main()
