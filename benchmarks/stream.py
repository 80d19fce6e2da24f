"""What a stream costs: CPU time a sample against `generate`.

    python benchmarks/stream.py --kind pillar

How long training waits for one says `benchmarks/training.py --stream pillar`.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import measuring

import scenegen
from scenegen.dataset.build import plan_dataset
from scenegen.dataset.shard import write_shard
from scenegen.recipe import preset
from scenegen.recipes import kind_names
from scenegen.source import DrawnWorlds
from scenegen.streams.stream import Stream

BATCH = 8


def generate(kind: str, count: int, first: int) -> None:
    """Write `count` samples as a shard, compact as a network needs it."""
    recipe = preset(kind)
    with tempfile.TemporaryDirectory() as folder:
        counts = {"train": (first + 1) * count, "val": 0, "test": 0}
        plan = plan_dataset(
            Path(folder),
            recipe,
            DrawnWorlds(recipe),
            seed=0,
            counts=counts,
            compact=True,
            shard_samples=count,
        )
        write_shard(plan.shards[first])


def read(samples: Stream, count: int, first: int) -> None:
    """Ask for what a network needs, a batch at a time."""
    for at in range(first * count, (first + 1) * count, BATCH):
        for sample in samples.__getitems__(range(at, min(at + BATCH, (first + 1) * count))):
            sample.observed, sample.free, sample.occupancy  # noqa: B018
    samples.close()


def ways(kind: str, workers: int, cache: Path) -> dict[str, Callable[[int, int], None]]:
    """What is compared, by name: functions of a count of samples and a round's number."""

    def stream(**how: Any) -> Callable[[int, int], None]:
        return lambda count, first: read(scenegen.stream(kind, **how), count, first)

    return {
        "generate --compact": partial(generate, kind),
        "stream, this process": stream(),
        f"stream, {workers} workers": stream(workers=workers),
        "stream, cache written": stream(cache=cache),
        "stream, cache read": stream(cache=cache),
    }


def main() -> None:
    """Parse, measure in turn, and print."""
    parser = measuring.options(__doc__)
    parser.add_argument("--kind", choices=kind_names(), help="one kind instead of two")
    parser.add_argument("--samples", type=int, default=100, help="samples of a round")
    parser.add_argument("--rounds", type=int, default=7, help="how often each is measured, in turn")
    parser.add_argument("--workers", type=int, default=2)
    options = measuring.parse(parser, kind="pillar", samples=8, rounds=1, workers=1)
    for kind in [options.kind] if options.kind else ["geometric", "pillar"]:
        generate(kind, 10, 0)  # kernels compile
        with tempfile.TemporaryDirectory() as cache:
            compared = ways(kind, options.workers, Path(cache))
            found: dict[str, list[measuring.Time]] = {name: [] for name in compared}
            for number in range(options.rounds):
                for name, way in compared.items():
                    found[name].append(measuring.timed(partial(way, options.samples, number)))
        print(
            f"\n{kind}: CPU ms a sample (ratio to generate), wall ms a sample; medians of "
            f"{options.rounds}"
        )
        medians = {name: measuring.median(times) for name, times in found.items()}
        base = medians["generate --compact"].processor
        for name, (wall, cpu) in medians.items():
            print(
                f"  {name:24} {cpu / options.samples:6.2f} ({cpu / base:.2f})   "
                f"{wall / options.samples:6.2f}"
            )


if __name__ == "__main__":
    main()
