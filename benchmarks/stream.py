"""What a stream costs: CPU time a sample against `generate`.

    python benchmarks/stream.py --kind pillar

How long training waits for one says `benchmarks/training.py --stream pillar`.
"""

import itertools
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import measuring

import scenegen
from scenegen.dataset.generation import plan_generation

BATCH = 8


class Options(measuring.Options):
    """What is measured."""

    kind: Sequence[str] = ("geometric", "pillar")
    samples: int = 100
    """samples of a round"""
    rounds: int = 7
    """how often each is measured, in turn"""
    workers: int = 2


def generate(kind: str, count: int, turn: int) -> None:
    """Write `count` samples as a shard, compact as a network needs it; others in each turn."""
    with tempfile.TemporaryDirectory() as folder:
        (plan,) = plan_generation(
            kind,
            (turn + 1) * count,
            val=0,
            test=0,
            out=folder,
            compact=True,
            shard_samples=count,
        ).datasets
        plan.shards[turn].write(Path(folder))


def read(kind: str, count: int, turn: int, **how: Any) -> None:
    """Ask a stream for what a network needs, a batch at a time."""
    samples = scenegen.stream(kind, **how)
    end = (turn + 1) * count
    for at in range(turn * count, end, BATCH):
        for sample in samples.__getitems__(range(at, min(at + BATCH, end))):
            sample.observed, sample.free, sample.occupancy  # noqa: B018
    samples.close()


def ways(given: Options, kind: str) -> dict[str, Callable[[], None]]:
    """What is compared, by name."""

    def each(way: Callable[..., None], **how: Any) -> Callable[[], None]:
        turns = itertools.count()
        return lambda: way(kind, given.samples, next(turns), **how)

    return {
        "generate --compact": each(generate),
        "stream, this process": each(read),
        f"stream, {given.workers} workers": each(read, workers=given.workers),
    }


def main() -> None:
    """Parse, measure in turn, and print."""
    given = measuring.parse(Options, kind=["pillar"], samples=8, rounds=1, workers=1)
    for kind in given.kind:
        medians = measuring.in_turn(ways(given, kind), given.rounds)
        print(f"\n{kind}: ms a sample, CPU (ratio to generate) and wall; medians of {given.rounds}")
        base = medians["generate --compact"].processor
        for name, (wall, cpu) in medians.items():
            print(
                f"  {name:24} {cpu / given.samples:6.2f} ({cpu / base:.2f})   "
                f"{wall / given.samples:6.2f}"
            )


if __name__ == "__main__":
    main()
