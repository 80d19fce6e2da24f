"""What all benchmarks share: their options, and what a command takes."""

import os
import resource
import statistics
import subprocess
import sys
import time
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import tyro

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


@typing.dataclass_transform(kw_only_default=True)
@dataclass(kw_only=True)
class Options:
    """What every benchmark is given. A benchmark's own options are the fields of a subclass, which
    is a dataclass, too: a field's type says what is given, and the text below it what for."""

    smoke: bool = False
    """as little as can be: does it run? Its figures mean nothing"""

    def __init_subclass__(cls) -> None:
        dataclass(kw_only=True)(cls)


Given = TypeVar("Given", bound=Options)


def parse(kind: type[Given], /, **smallest: Any) -> Given:
    """What was given, as an instance of `kind`. With --smoke, the `smallest` values are the
    defaults. The help begins as the script does."""
    usual: Any = kind(**smallest) if smallest and "--smoke" in sys.argv else tyro.MISSING_NONPROP
    flags = [word for word in sys.argv if word.startswith("--")]
    if len(set(flags)) < len(flags):
        raise SystemExit("an option stands there twice; give all its words after one")
    return tyro.cli(kind, description=sys.modules["__main__"].__doc__, default=usual)


def processor_s() -> float:
    """User and system time of this process and of its children that ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def timed(task: Callable[[], object]) -> Time:
    """What `task` takes."""
    begin, used = time.perf_counter(), processor_s()
    task()
    return Time((time.perf_counter() - begin) * 1e3, (processor_s() - used) * 1e3)


def in_turn(
    tasks: Mapping[str, Callable[[], object]],
    rounds: int,
    *,
    burst: int = 1,
    of: Callable[[Iterable[float]], float] = statistics.median,
) -> dict[str, Time]:
    """What each task takes. Tasks take turns, so that all meet the same machine.

    Args:
        tasks: By name.
        rounds: How often each has its turn. A round goes before, in which kernels compile; its
            times do not count.
        burst: How often a task is done in each turn. Where that is more than once, the first time
            does not count: threads of the task before still wait for work.
        of: What makes one figure of all times.
    """
    found: dict[str, list[Time]] = {name: [] for name in tasks}
    for turn in range(rounds + 1):
        for name, task in tasks.items():
            times = [timed(task) for _ in range(burst)]
            found[name] += (times[1:] or times) if turn else []
    return {name: Time(*map(of, zip(*times, strict=True))) for name, times in found.items()}


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


def command(words: str, *more: object) -> tuple[Cost, str]:
    """Run a command of scenegen, as `run` does: its words, and then `more`, which may have
    spaces."""
    return run("-m", "scenegen", *words.split(), *more)
