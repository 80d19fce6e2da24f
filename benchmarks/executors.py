"""What it costs to have shards written elsewhere: processor and wall time of the same command by
every executor.

python benchmarks/executors.py --samples 20000 --workers 2 python -m
tests.scenegen.run.slurm_here python benchmarks/executors.py        begins a Slurm for it, as
root

Ray is measured where it is installed, Slurm where one answers. Processor time is that of all
processes that a command begins, wherever they hang: they are known by their environment, and looked
at ten times a second.
"""

import json
import os
import secrets
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import measuring

from scenegen.recipes import kind_names
from scenegen.run.workers import cores

MARK = "SCENEGEN_BENCHMARK"
LOOK_S = 0.1
TICKS = os.sysconf("SC_CLK_TCK")


class Meter:
    """Processor time of all processes whose environment has the same mark, and the greatest memory
    of one of them."""

    def __init__(self) -> None:
        self.mark = secrets.token_hex(8)
        self._wanted = f"{MARK}={self.mark}".encode()
        self._known: dict[tuple[int, str], bool] = {}
        self._spent: dict[tuple[int, str], float] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look)

    def __enter__(self) -> "Meter":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()

    @property
    def cpu_s(self) -> float:
        """All of them together, as far as they were seen."""
        return sum(self._spent.values())

    def _look(self) -> None:
        while not self._ended.wait(LOOK_S):
            for place in Path("/proc").glob("[0-9]*"):
                with suppress(OSError):
                    fields = (place / "stat").read_text().rpartition(")")[2].split()
                    process = (
                        int(place.name),
                        fields[19],
                    )  # with when it began: numbers are used again
                    if not self._known.get(
                        process
                    ):  # a process that was forked has yet to begin its own program
                        self._known[process] = self._wanted in (
                            place / "environ"
                        ).read_bytes().split(b"\0")
                    if self._known[process]:
                        self._spent[process] = (int(fields[11]) + int(fields[12])) / TICKS


def measure(place: str, words: list[str], workers: int) -> tuple[float, float, float, str]:
    """Processor time and wall time, seconds; greatest memory of what was begun here, MB; and the
    dataset's digest."""
    size = workers if place == "rank" else 1
    each = 1 if place == "rank" else workers
    more = f"--json --on {place} --workers {each}".split()
    command = [sys.executable, "-m", "scenegen", *words, *more]
    with Meter() as meter:
        environment = os.environ | {MARK: meter.mark, "SCENEGEN_WORLD_SIZE": str(size)}
        begin = time.perf_counter()
        running = [
            subprocess.Popen(
                command,
                env=environment | {"SCENEGEN_RANK": str(rank)},
                stdout=subprocess.PIPE,
                text=True,
            )
            for rank in range(size)
        ]
        said, peak = [], 0.0
        for one in running:
            assert one.stdout is not None
            said.append(one.stdout.read())
            _, status, usage = os.wait4(one.pid, 0)
            one.returncode = os.waitstatus_to_exitcode(status)
            if one.returncode:
                sys.exit(f"{place}: ended with {one.returncode}")
            peak = max(peak, usage.ru_maxrss / 1024)
        wall = time.perf_counter() - begin
    (digest,) = filter(None, (json.loads(line)["digest"] for line in said))
    return meter.cpu_s, wall, peak, digest


def absent(place: str) -> bool:
    """Whether an executor cannot be measured: its package is not installed, or no Slurm answers."""
    package = {"ray": "ray", "slurm": "submitit"}.get(place)
    if package and not find_spec(package):
        return True
    return place == "slurm" and bool(
        subprocess.run("sinfo", shell=True, capture_output=True).returncode
    )


def main() -> None:
    """Parse, measure in turn, and print."""
    parser = measuring.options(__doc__)
    parser.add_argument("--kind", choices=kind_names(), default="pillar")
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3, help="how often each is measured, in turn")
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--on", action="append", help="an executor; repeatable  [default: all]")
    options = measuring.parse(parser, samples=5, rounds=1, workers=1, on=["rank", "ray"])
    places = options.on or ["local", "rank", "ray", "slurm"]
    for place in filter(absent, [*places]):
        places.remove(place)
        print(f"{place}: not measured, for it is not here")
    found: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    digests = set()
    with tempfile.TemporaryDirectory() as folder:
        generate = f"generate {options.kind} --val 0 --test 0 --n".split()
        small = [*generate, "2", "--out", f"{folder}/first"]
        measure("local", small, 1)  # kernels compile
        for _ in range(options.rounds):
            for place in places:
                out = Path(folder) / "d"
                words = [*generate, str(options.samples)]
                *spent, digest = measure(place, [*words, "--out", str(out)], options.workers)
                found[place].append((spent[0], spent[1], spent[2]))
                digests.add(digest)
                shutil.rmtree(out)
                print(
                    f"{place:6} {spent[0]:8.2f} s of processor, {spent[1]:8.2f} s, {spent[2]:.0f} "
                    f"MB",
                    flush=True,
                )
    assert len(digests) == 1, "the same bits wherever they are made"
    print(
        f"\n{options.kind}, {options.samples} samples, {options.workers} workers; medians of "
        f"{options.rounds}"
    )
    print("          processor s   ratio   wall s   ratio   memory of the command, MB")
    base = [statistics.median(column) for column in zip(*found[places[0]], strict=True)]
    for place in places:
        cpu, wall, peak = (statistics.median(column) for column in zip(*found[place], strict=True))
        print(
            f"  {place:6} {cpu:12.2f} {cpu / base[0]:8.3f} {wall:8.2f} {wall / base[1]:7.3f} "
            f"{peak:9.0f}"
        )


if __name__ == "__main__":
    main()
