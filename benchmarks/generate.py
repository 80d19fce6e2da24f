"""What a sample costs: milliseconds per stage, samples per second and core, memory and size; then
whole runs.

    python benchmarks/generate.py [--kind pillar] [--seconds 10] [--runs]

The stages are those of the real pipeline, timed where it calls them, by processor time, user's and
system's: that is what to compare on a machine that does other work. `--runs` also times the start
of a process, and `scenegen generate --n 2500` on all cores; whole commands and rates stand there by
the clock, too, which alone counts the waiting for the disk.
"""

import json
import pkgutil
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import measuring

from scenegen.base.executors import cores
from scenegen.dataset.generation import plan_generation

STAGES = {
    "draw world, write MJCF, compile": "scenegen.draw.source.write_world",
    "  of which compile, read solids": "scenegen.worlds.world.compile_world",
    "plan flight": "scenegen.draw.draw.plan_flight",
    "  of which RRT": "scenegen.worlds.flight.connect",
    "make engine": "scenegen.worlds.world.World.caster",
    "cast rays": "scenegen.draw.draw.cast",
    "occupancy": "scenegen.worlds.world.rasterize",
    "observed and free": "scenegen.draw.draw.fuse",
    "distance": "scenegen.draw.draw.distance_field",
    "compress": "scenegen.dataset.shard.compress",
    "sample digest": "scenegen.draw.sample.Sample.sha256",
    "file digest": "scenegen.dataset.shard.sha256_of",
    "write and sync": "scenegen.dataset.shard.create_at",
}
ELSE = "everything else"


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
        for name, target in STAGES.items():
            stand_in = timed(name, pkgutil.resolve_name(target))
            stack.enter_context(patch(target, stand_in))
        yield seconds


def measure(kind: str, seconds: float) -> None:
    """Write shards in this process for `seconds`, and print what they and their stages took."""
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder, stopwatch() as spent:
        (plan,) = plan_generation(kind, 100_000, val=0, test=0, out=folder).datasets
        plan.shards[0].write(Path(folder))  # kernels compile, caches fill
        spent.clear()
        begin, used, samples, size = time.perf_counter(), measuring.processor_s(), 0, 0
        for shard in plan.shards[1:]:
            report = shard.write(Path(folder))
            samples, size = samples + report.entry.samples, size + report.size
            if time.perf_counter() - begin > seconds:
                break
        wall, used = time.perf_counter() - begin, measuring.processor_s() - used
    if idle := STAGES.keys() - spent:
        sys.exit(f"{kind}: nothing was timed of {', '.join(sorted(idle))}; see STAGES")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"\n{kind}: {samples / wall:.0f} samples a second and core ({samples / used:.0f} by "
        f"processor time), {wall / samples * 1e3:.2f} ms a sample ({used / samples * 1e3:.2f} of "
        f"processor), {size / samples / 1e3:.1f} KB a sample, peak memory {peak:.0f} MB"
    )
    whole = sum(taken for name, taken in spent.items() if not name.startswith("  "))
    spent[ELSE] = used - whole
    for name in (*STAGES, ELSE):
        print(f"  {name:34} {1e3 * spent[name] / samples:6.3f} ms {spent[name] / used:5.0%}")


def time_runs(kind: str, count: int) -> None:
    """Whole commands on all cores: full and compact, each with its own start-up and its workers'
    memory."""
    for flags in ((), ("--compact",)):
        with tempfile.TemporaryDirectory(dir=Path.cwd()) as folder:
            words = f"generate --kind {kind} --n {count} --json --out"
            cost, printed = measuring.command(words, folder, *flags)
        said = json.loads(printed)
        made = sum(said["samples"].values())
        print(
            f"{' '.join((kind, '--n', str(count), *flags))}: {made} samples in {cost.wall_s:.1f} "
            f"s on {cores()} cores, {cost.processor_s:.1f} s of processor, "
            f"{said['bytes'] / made / 1e3:.1f} KB a sample, largest process {cost.megabytes:.0f} MB"
        )


class Options(measuring.Options):
    """What is measured."""

    kind: Sequence[str] = ("geometric", "pillar")
    seconds: float = 10.0
    """how long to measure each kind"""
    runs: bool = False
    """also time whole commands"""
    n: int = 2500
    """training samples of a whole command"""


def main() -> None:
    """Parse and measure."""
    given = measuring.parse(Options, kind=["pillar"], seconds=0, runs=True, n=5)
    for kind in given.kind:
        measure(kind, given.seconds)
    if given.runs:
        start = measuring.command("--version")[0]
        print(f"\nstart of a process: {start.processor_s:.2f} s of processor")
        for kind in given.kind:
            time_runs(kind, given.n)


if __name__ == "__main__":
    main()
