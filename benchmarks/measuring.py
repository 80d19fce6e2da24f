"""What all benchmarks share: their options, and what a command takes."""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as the command does, before torch is loaded


class Time(NamedTuple):
    """What a piece of work took, milliseconds."""

    wall: float
    processor: float
    """User and system time of all threads, and of processes that ended meanwhile."""


class Cost(NamedTuple):
    """What a command and its processes took."""

    processor_s: float
    """User and system time of all of them."""
    wall_s: float
    megabytes: float
    """Memory of the largest of them."""


def options(doc: str | None) -> argparse.ArgumentParser:
    """A parser whose help is `doc`, the first lines of a benchmark."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--smoke",
        action="store_true",
        help="as little as can be: does it run? Its figures mean nothing",
    )
    return parser


def parse(parser: argparse.ArgumentParser, **smallest: Any) -> argparse.Namespace:
    """What was given; with --smoke, the `smallest` values are the defaults."""
    if "--smoke" in sys.argv:
        parser.set_defaults(**smallest)
    return parser.parse_args()


def processor_s() -> float:
    """User and system time of this process and of its children that ended."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)


def timed(task: Callable[[], object]) -> Time:
    """What `task` takes."""
    begin, used = time.perf_counter(), processor_s()
    task()
    return Time((time.perf_counter() - begin) * 1e3, (processor_s() - used) * 1e3)


def median(times: Iterable[Time]) -> Time:
    """The medians of both clocks."""
    return Time(*map(statistics.median, zip(*times, strict=True)))


def run(*command: object) -> tuple[Cost, str]:
    """Run this Python with the words of `command`: what it took, and what it printed.

    Raises RuntimeError where it fails.
    """
    words = [sys.executable, *map(str, command)]
    begin = time.perf_counter()
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process.stdout:
        said = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(words[1:])}: ended with {process.returncode}")
    wall = time.perf_counter() - begin
    return Cost(used.ru_utime + used.ru_stime, wall, used.ru_maxrss / 1024), said
