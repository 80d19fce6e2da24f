"""What verifying costs: samples per second and core, by the clock and by processor time, and what
each check takes.

    python benchmarks/verify.py data/pillar [data/geometric ...] [--workers 1]

Every dataset's files are loaded into memory; then `scenegen verify` checks it, once in full and
once with `--quick`. Processor time is that of all processes together, start-up included, and is
what to compare on a machine that does other work. Memory is that of the largest process.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import measuring
from tyro.conf import Positional


class Options(measuring.Options):
    """What is checked."""

    datasets: Positional[Sequence[Path]]
    workers: int = 1


def main() -> None:
    """Print a table for every dataset."""
    given = measuring.parse(Options)
    if not given.datasets:
        raise SystemExit("give datasets")
    for folder in given.datasets:
        for path in folder.iterdir():
            path.read_bytes()
        for mode in ((), ("--quick",)):
            words = f"verify --json --workers {given.workers}"
            cost, said = measuring.command(words, folder, *mode)
            found = json.loads(said)
            samples, seconds = found["samples"], found["seconds"]
            rate = samples / seconds / given.workers
            print(f"\n{' '.join((str(folder), *mode))}: {samples} samples, no check failed")
            print(f"  by the clock        {rate:6.0f} samples a second and core ({seconds:.1f} s)")
            print(f"  by processor time   {samples / cost.processor_s:6.0f} samples a second")
            print(f"  largest process     {cost.megabytes:6.0f} MB")
            for check in found["checks"]:
                each = 1e3 * check["seconds"] / samples
                print(f"  {check['name']:12} {each:8.3f} ms a sample")


if __name__ == "__main__":
    main()
