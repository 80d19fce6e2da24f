"""What a sample costs here and in another checkout: processor milliseconds, run by run in turn, and
their ratio.

    git worktree add /tmp/before 59ac7f1
    python benchmarks/against.py /tmp/before [--kind pillar] [--samples 1000] [--engine analytic]

Both generate the same dataset with the same Python and the same libraries, by one worker, and in
turn, so that a busy machine slows both. What one sample takes, start-up above all, is taken off. It
ends with 1 where their samples differ.
"""

import os
import statistics
import sys
import tempfile
from pathlib import Path

import measuring

from scenegen.dataset.read import Dataset

HERE = Path(__file__).parents[1]


def generated(
    checkout: Path, kind: str, samples: int, more: list[str]
) -> tuple[float, list[bytes]]:
    """Processor seconds that so many samples take in a checkout, and the samples' digests."""
    os.environ["PYTHONPATH"] = str(checkout)
    words = f"generate --kind {kind} --n {samples} --val 0 --test 0 --workers 1 --quiet".split()
    with tempfile.TemporaryDirectory() as folder:
        cost, _ = measuring.run("-P", "-m", "scenegen", *words, *more, "--out", folder)
        digests = [sample.sha256() for sample in Dataset(folder).split("train")]
    return cost.processor_s, digests


def compare(checkout: Path, kind: str, samples: int, rounds: int, engine: str) -> bool:
    """Print what both take; whether their samples are the same."""
    ours = ["--engine", engine] if engine else []
    sides: list[tuple[Path, list[str], list[float]]] = [(checkout, [], []), (HERE, ours, [])]
    seen = set()
    for _ in range(rounds):
        for folder, more, spent in sides:
            idle, _ = generated(folder, kind, 1, more)
            seconds, digests = generated(folder, kind, samples, more)
            spent.append((seconds - idle) / samples * 1e3)
            seen.add(tuple(digests))
    there, here = (statistics.median(spent) for *_, spent in sides)
    print(
        f"{kind}: {there:.2f} ms a sample there, {here:.2f} here, {there / here:.2f} times as "
        f"fast; samples {'equal' if len(seen) == 1 else 'DIFFER'}"
    )
    return len(seen) == 1


def main() -> None:
    """Parse and compare."""
    parser = measuring.options(__doc__)
    parser.add_argument("checkout", type=Path, help="the other checkout's folder")
    parser.add_argument("--kind", action="append", help="repeatable  [default: two]")
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=3, help="how often each is measured, in turn")
    parser.add_argument("--engine", default="", help="what casts the rays here, if not the default")
    given = measuring.parse(parser, kind=["pillar"], samples=100, rounds=1)
    checkout, numbers = given.checkout.resolve(), (given.samples, given.rounds, given.engine)
    kinds = given.kind or ["pillar", "geometric"]
    same = [compare(checkout, kind, *numbers) for kind in kinds]
    sys.exit(0 if all(same) else 1)


if __name__ == "__main__":
    main()
