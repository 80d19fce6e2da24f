"""What verifying costs: samples per second and core, by the clock and by processor time, and what
each check takes.

    python benchmarks/verify.py data/pillar [data/geometric ...] [--workers 1]

Every dataset is verified in a process of its own, once to load its files into memory and then once
in full and once with `--quick`. By the clock, start-up is included; processor time is that of all
processes together, and is what to compare on a machine that does other work. Memory is that of the
largest process.
"""

import argparse
import json
import resource
import time
from pathlib import Path
from typing import Any

import measuring


def measure(folder: Path, *, quick: bool, workers: int) -> dict[str, Any]:
    """One verification in this process, and what it took."""
    from scenegen.verification import verify

    begin = time.perf_counter()
    report = verify(folder, quick=quick, workers=workers)
    seconds = time.perf_counter() - begin
    usage = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return {
        "samples": report.samples,
        "failed": report.failed,
        "seconds": seconds,
        "processor": measuring.processor_s(),
        "megabytes": max(one.ru_maxrss for one in usage) / 1e3,
        "checks": {check.name: check.seconds for check in report.checks},
    }


def main() -> None:
    """Print a table for every dataset."""
    parser = measuring.options(__doc__)
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--one", choices=["full", "quick"], help=argparse.SUPPRESS)
    given = measuring.parse(parser)
    if given.one:
        print(
            json.dumps(
                measure(given.datasets[0], quick=given.one == "quick", workers=given.workers)
            )
        )
        return
    for folder in given.datasets:
        for path in folder.iterdir():
            path.read_bytes()
        for mode in ("full", "quick"):
            words = [__file__, folder, "--workers", given.workers, "--one", mode]
            found = json.loads(measuring.run(*words)[1])
            rate = found["samples"] / found["seconds"] / given.workers
            print(
                f"\n{folder}, {mode}: {found['samples']} samples, failed: "
                f"{', '.join(found['failed']) or 'none'}"
            )
            print(
                f"  by the clock        {rate:6.0f} samples a second and core "
                f"({found['seconds']:.1f} s)"
            )
            print(
                f"  by processor time   {found['samples'] / found['processor']:6.0f} samples a "
                f"second"
            )
            print(f"  largest process     {found['megabytes']:6.0f} MB")
            for name, seconds in found["checks"].items():
                print(f"  {name:12} {1e3 * seconds / found['samples']:8.3f} ms a sample")


if __name__ == "__main__":
    main()
