"""A rehearsal of a large run, on one machine: many nodes fill one bucket, and all that can go wrong
does.

    nice -n 15 python benchmarks/rehearsal.py --samples 100000 --nodes 50 [--at-once 4]

Every node is a process of `scenegen generate --on rank` with a home of its own; all share compiled
kernels. Two drivers are at work at once: half of the nodes make the whole dataset, and so do the
others. Every ten seconds a node that works is killed, and waits for its turn again. The bucket is a
server of S3's protocol in this process; it refuses one request in a hundred, and cuts off as many
answers. One node more has another version of scenegen, and must be refused. Maps are tiny. The
digest in the end is held against that of a folder which one process filled undisturbed.
"""

import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import measuring
from folders import RECIPE
from served import Served

from lidarsim.jit import cache_root

PLACE = "s3://lab/d"
OTHER = "import sys, scenegen; scenegen.__version__ = '0'; sys.argv[0] = 'scenegen'; "
OTHER += "from scenegen.__main__ import main; main()"
"""What a node runs whose scenegen is another one."""


class Options(measuring.Options):
    """How large the run is."""

    samples: int = 100_000
    shard_samples: int = 200
    nodes: int = 50
    at_once: int = 4
    """nodes; the others wait"""
    kill_s: float = 10.0
    """between two kills"""


def main() -> None:
    """Make the dataset undisturbed, then among disturbances, and print what both took."""
    given = measuring.parse(Options, samples=60, shard_samples=5, nodes=4, kill_s=9.0)
    with tempfile.TemporaryDirectory() as name, Served(Path(name, "s"), fail_every=50) as server:
        here = Path(name)
        os.environ |= server.environment | {"SCENEGEN_CACHE": str(cache_root())}
        (here / "tiny.toml").write_text(RECIPE)
        words = (
            f"generate --n {given.samples} --val 0 --test 0 --compact --json --recipe "
            f"{here}/tiny.toml --shard-samples {given.shard_samples} --workers 1 --out"
        )
        undisturbed, said = measuring.command(words, here / "d")
        cost, killed = disturbed(f"{words} {PLACE} --on rank".split(), given, here)
        found = json.loads(measuring.command(words, PLACE)[1])
        measuring.command(f"verify {PLACE} --quick --quiet")
        assert found["digest"] == json.loads(said)["digest"], "the same bits"
    print(f"{given.samples} samples in {found['shards']} shards, digest {found['digest'][:12]}")
    print("| | processor s | clock s |\n|---|---|---|")
    print(f"| one process, a folder | {undisturbed.processor_s:.0f} | {undisturbed.wall_s:.0f} |")
    print(f"| {given.nodes} nodes, a bucket | {cost.processor:.0f} | {cost.wall:.0f} |")
    print(f"{killed} nodes killed; one of another version refused")
    asked = len(server.log)
    print(f"{asked} requests, {asked // server.fail_every} of them refused or cut off")


def disturbed(command: list[str], given: Options, here: Path) -> tuple[measuring.Time, int]:
    """What it takes, seconds, until every node has ended well, and how often one was killed."""
    rng, size, killed = random.Random(0), given.nodes // 2, 0
    begin, used = time.perf_counter(), measuring.processor_s()

    def node(number: int, *program: str) -> "subprocess.Popen[str]":
        home = here / f"node{number}"
        home.mkdir(exist_ok=True)
        own = {
            "HOME": str(home),
            "SCENEGEN_RANK": str(number % size),
            "SCENEGEN_WORLD_SIZE": str(size),
        }
        return subprocess.Popen(
            [sys.executable, *program, *command],
            env=os.environ | own,
            cwd=home,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    waiting, last = list(range(given.nodes)), begin
    rng.shuffle(waiting)
    running: dict[int, subprocess.Popen[str]] = {}
    while waiting or running:
        while waiting and len(running) < given.at_once:
            number = waiting.pop(0)
            running[number] = node(number, "-m", "scenegen")
        time.sleep(0.1)
        if time.perf_counter() - last > given.kill_s:
            last = time.perf_counter()
            running[rng.choice(list(running))].kill()
        for number, process in list(running.items()):
            if process.poll() is not None:
                _, wrong = process.communicate()
                del running[number]
                if process.returncode < 0:
                    killed += 1
                    waiting.append(number)
                elif process.returncode:
                    sys.exit(f"node {number}: {wrong}")
    other = node(given.nodes, "-c", OTHER)
    assert "software.scenegen is" in other.communicate()[1], "another version was not refused"
    spent = measuring.processor_s() - used
    return measuring.Time(time.perf_counter() - begin, spent), killed


if __name__ == "__main__":
    main()
