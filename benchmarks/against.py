"""What a sample costs here and in another checkout: processor milliseconds, shard by shard in turn,
and their ratio.

    git worktree add /tmp/before 59ac7f1
    python benchmarks/against.py /tmp/before [--kind pillar] [--shards 10] [--engine analytic]

Both write the same shards with the same Python and the same libraries, and in turn, so that a busy
machine slows both. It ends with 1 where their samples differ.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import measuring

HERE = Path(__file__).parents[1]


def serve(kind: str, engine: str) -> None:
    """Write the shards whose numbers come through the standard input, and answer a line of JSON for
    each: processor seconds, samples, bytes, and the samples' digests."""
    import scenegen.run.workers
    from scenegen.dataset.build import plan_dataset
    from scenegen.dataset.shard import write_shard
    from scenegen.recipe import preset
    from scenegen.source import DrawnWorlds

    if keep_memory := getattr(
        scenegen.run.workers, "keep_memory", None
    ):  # as the command does, in checkouts that have it
        keep_memory()
    recipe = preset(kind)
    counts = {"train": 100_000, "val": 0, "test": 0}
    chosen: dict[str, Any] = {"engine": engine} if engine else {}
    with tempfile.TemporaryDirectory() as folder:
        plan = plan_dataset(
            Path(folder), recipe, DrawnWorlds(recipe), seed=0, counts=counts, **chosen
        )
        for line in sys.stdin:
            begin = time.process_time()
            report = write_shard(plan.shards[int(line)])
            answer = time.process_time() - begin, report.samples, report.size, report.digests.hex()
            print(json.dumps(answer), flush=True)


def start(checkout: Path, kind: str, engine: str) -> "subprocess.Popen[str]":
    """A process that runs `serve` with the packages of `checkout`."""
    command = [
        sys.executable,
        __file__,
        str(checkout),
        "--serve",
        "--kind",
        kind,
        "--engine",
        engine,
    ]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def ask(process: "subprocess.Popen[str]", shard: int) -> Any:
    """What writing a shard took in that process."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(f"{shard}\n")
    process.stdin.flush()
    return json.loads(process.stdout.readline())


def compare(checkout: Path, kind: str, shards: int, engine: str) -> bool:
    """Print what both take; whether their samples are the same."""
    with start(checkout, kind, "") as before, start(HERE, kind, engine) as now:
        same = True
        seconds, sizes, samples = [0.0, 0.0], [0, 0], 0
        for shard in range(shards + 1):
            answers = [ask(process, shard) for process in (before, now)]
            same = same and answers[0][3] == answers[1][3]
            if shard > 0:  # in the first one kernels compile and caches fill
                samples += answers[0][1]
                for side, (spent, _, size, _) in enumerate(answers):
                    seconds[side], sizes[side] = seconds[side] + spent, sizes[side] + size
    there, here = (spent / samples * 1e3 for spent in seconds)
    print(
        f"{kind}: {there:.2f} ms a sample there, {here:.2f} here, {there / here:.2f} times as "
        f"fast; stored size "
        f"{sizes[1] / sizes[0] - 1:+.2%}; samples {'equal' if same else 'DIFFER'}"
    )
    return same


def main() -> None:
    """Parse and compare."""
    parser = measuring.options(__doc__)
    parser.add_argument("checkout", type=Path, help="the other checkout's folder")
    parser.add_argument("--kind", choices=("pillar", "geometric"), help="one kind instead of both")
    parser.add_argument(
        "--shards", type=int, default=10, help="shards of 100 samples to write on either side"
    )
    parser.add_argument("--engine", default="", help="what casts the rays here, if not the default")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = measuring.parse(parser, kind="pillar", shards=1)
    if options.serve:
        serve(options.kind, options.engine)
        return
    kinds = [options.kind] if options.kind else ["pillar", "geometric"]
    same = [
        compare(options.checkout.resolve(), kind, options.shards, options.engine) for kind in kinds
    ]
    sys.exit(0 if all(same) else 1)


if __name__ == "__main__":
    main()
