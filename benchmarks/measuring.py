"""What all benchmarks share: their options, and what a command takes."""

import argparse
import inspect
import os
import re
import resource
import statistics
import subprocess
import sys
import time
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from scenegen.recipes import kind_names

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


Kind = Annotated[str, kind_names()]
"""A kind of worlds."""
Given = TypeVar("Given", bound=Options)


def parse(kind: type[Given], /, *unnamed: str, **smallest: Any) -> Given:
    """What was given, as an instance of `kind`: some fields `unnamed`, all others as --field. With
    --smoke, the `smallest` values are the defaults. The help begins as the script does."""
    parser = argparse.ArgumentParser(
        description=sys.modules["__main__"].__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    types, helps = typing.get_type_hints(kind, include_extras=True), _helps(kind)
    for one in fields(kind):
        flag = one.name if one.name in unnamed else "--" + one.name.replace("_", "-")
        more = _settings(types[one.name])
        if one.default is None and one.name in unnamed:
            more |= {"nargs": "?", "default": None}
        elif one.default is MISSING and "nargs" in more:
            more["nargs"] = "+"
        parser.add_argument(flag, help=helps.get(one.name), **more)
    given = vars(parser.parse_args())
    return kind(**(smallest if "smoke" in given else {}) | given)


def _settings(hint: Any) -> dict[str, Any]:
    """What argparse is told of an option whose type is `hint`: of a sequence, several words are
    taken; of `Annotated[type, choices]` or a literal, one of the choices."""
    if hint is bool:
        return {"action": "store_true"}
    several = typing.get_origin(hint) is Sequence
    if several or type(None) in typing.get_args(hint):  # of a type and None, it is the first
        hint = typing.get_args(hint)[0]
    more = {"action": "extend", "nargs": "*"} if several else {}
    choices = getattr(hint, "__metadata__", [None])[0]
    if typing.get_origin(hint) is Literal:
        choices = typing.get_args(hint)
        hint = type(choices[0])
    return {"type": getattr(hint, "__origin__", hint), "choices": choices, **more}


def _helps(kind: type) -> dict[str, str]:
    """The texts that stand below the fields of a class, and of those that it comes from."""
    source = "".join(inspect.getsource(one) for one in reversed(kind.__mro__[:-1]))
    return dict(re.findall(r'(\w+):[^\n]*\n    """(.*?)"""', source, re.DOTALL))


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
