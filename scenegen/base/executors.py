"""Executors: where tasks run. `workers` runs them on this machine, `ray` on a cluster.

The result of a task depends on the task alone. A command therefore writes the same bits on every
executor.
"""

import hashlib
import os
import platform
import subprocess
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import lidarsim
import scenegen
from lidarsim.jit import sources
from lidarsim.registry import Registry
from scenegen.base.errors import ScenegenError, reraise_as

Function = Callable[[Any], Any]
"""Applied to each task."""
Begun = Callable[[], None]
"""Called once when all workers have started."""
Results = Generator[Any, None, None]
"""Results in the order in which tasks finish."""
Counted = Callable[[int], None]
"""Called with the total number of samples, or with the number of newly finished ones."""


LOCATED: dict[Path, tuple[Any, ...]] = {}
"""Local copies of remote datasets, by folder: the function that finds the dataset on another
machine, and its arguments, the dataset's name first."""


def cores() -> int:
    """Number of CPU cores that this process may use."""
    # not `os.cpu_count`, which also counts cores that a job of a cluster may not use
    return len(os.sched_getaffinity(0))


def chunked(items: Sequence[Any], size: int) -> list[Any]:
    """Cut a sequence into parts.

    Args:
        items: The sequence.
        size: Length of a part; the last may be shorter.

    Returns:
        The parts, in order.
    """
    return [items[first : first + size] for first in range(0, len(items), size)]


def unheard(samples: int) -> None:
    """Ignore progress."""


def counted(
    execute: "Executor",
    function: Function,
    tasks: Sequence[Any],
    *,
    total: int,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
    size: Callable[[Any], int] = len,
) -> Iterator[Any]:
    """Run tasks, report progress, and yield the results as they come.

    Args:
        execute: The executor.
        function: Applied to each task.
        tasks: The tasks.
        total: Number of samples in all tasks.
        on_start: Called with `total` when the workers have started.
        on_done: Called with the number of samples of each result.
        size: Number of samples of a result.

    Yields:
        The results, in the order in which tasks finish.
    """
    # closing ends the workers when the caller stops early
    with closing(execute(function, tasks, lambda: on_start(total))) as results:
        for result in results:
            on_done(size(result))
            yield result


class Executor(Protocol):
    """A place where tasks run, made from an address ("" for none) and a number of workers."""

    def __init__(self, address: str, workers: int) -> None: ...

    def mine(self, tasks: Sequence[Any]) -> Sequence[Any]:
        """Tasks of a run, finished or not, that this process is responsible for: all by default."""
        return tasks

    def __call__(self, function: Function, tasks: Sequence[Any], on_start: Begun) -> Results:
        """Apply `function` to `tasks`, and yield the results in any order.

        Closing the generator ends only the workers that it started.

        Args:
            function: Applied to each task. It is pickled, as the tasks are. Files that tasks name
                must be readable on every machine; `scenegen.base.ray` replaces local copies of a
                store by the store's name.
            tasks: The tasks.
            on_start: Called once when the workers have started.

        Yields:
            The results.

        Raises:
            GenerationError: if a task cannot be finished. Errors of `function` pass through.
        """
        ...


EXECUTORS = Registry(
    "executor",
    {
        "local": "scenegen.base.workers:Local",
        "rank": "scenegen.base.workers:Rank",
        "ray": "scenegen.base.ray:Ray",
    },
    needs={
        "mine": "a method: tasks -> tasks",
        "__call__": "a method: (function, tasks, on_start) -> results",
    },
)
"""Executors by name."""
LOCAL = "local"
"""Name of the default executor."""


def executor(place: str, workers: int) -> Executor:
    """Make an executor by its name.

    Args:
        place: A name, with or without an address, such as ``ray://10.0.0.1:10001``.
        workers: Number of worker processes.

    Raises:
        ScenegenError: if there is no such executor, or it cannot be made.
    """
    name, _, address = place.partition("://")
    with reraise_as(ScenegenError, "--on: "):
        return EXECUTORS.find(name)(address, workers)


def check_together(execute: Executor, command: str) -> None:
    """Check that this process receives the results of all tasks.

    Args:
        execute: The executor.
        command: Subject and verb of the message, such as "bench needs".

    Raises:
        ScenegenError: if the executor leaves tasks to other processes.
    """
    # the second of two tasks would be another process's
    if len(execute.mine((0, 1))) < 2:
        raise ScenegenError(
            f"--on: {command} all results, and jobs that know their rank alone bring none "
            "together; give --on ray, or each job work of its own with --on local"
        )


# a stop ends the process in its signal handler, where no `finally` runs
_begun: list[Callable[[], object]] = []


@contextmanager
def undone_if_stopped(undo: Callable[[], object]) -> Iterator[None]:
    """Register `undo` for `undo_all` while the block runs.

    Args:
        undo: Called if the process is stopped. It must be quick, take no lock, and may return a
            line for the message.
    """
    _begun.append(undo)
    try:
        yield
    finally:
        _begun.remove(undo)


@contextmanager
def undone(undo: Callable[[], object]) -> Iterator[None]:
    """Call `undo` when the block ends, by an error or a stop as well.

    Args:
        undo: As for `undone_if_stopped`.
    """
    with undone_if_stopped(undo):
        try:
            yield
        finally:
            undo()


def undo_all() -> str:
    """Undo unfinished work, latest first, before the process exits: remove temporary files, end
    workers.

    Returns:
        A line about the stop for the user, or "".
    """
    line = ""
    for undo in reversed(_begun):
        # one failing undo must not prevent the others
        with suppress(Exception):
            result = undo()
            line = result if isinstance(result, str) else line
    return line


PACKAGES = ("mujoco", "ompl", "numpy", "numba", "trimesh")
"""Packages whose version may change the bits of a dataset."""


def software() -> dict[str, str]:
    """Versions of scenegen, the machine's architecture, and `PACKAGES`."""
    versions = {"scenegen": scenegen.__version__, "machine": platform.machine()}
    return versions | {package: installed(package) for package in PACKAGES}


def processor() -> str:
    """Name of this machine's processor."""
    with suppress(OSError):  # elsewhere than on Linux
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "CPU"


@cache
def installed(package: str) -> str:
    """Version of an installed package, or ``absent``."""
    # importing this takes longer than reading a manifest
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


@cache
def identity() -> dict[str, Any]:
    """What machines must share to work on one result: `software`, the generator's version, and a
    digest of all Python files of both packages."""
    # the version alone does not tell two checkouts apart
    digest = hashlib.sha256()
    for path in sources(*(Path(str(package.__file__)).parent for package in (lidarsim, scenegen))):
        digest.update(path.read_bytes())
    return software() | {"generator": scenegen.GENERATOR, "source": digest.hexdigest()[:12]}


def commit() -> str:
    """Commit of this checkout, with "+" if it has changes; ``unknown`` if scenegen is not in a
    checkout of its own."""
    root = Path(__file__).resolve().parents[2]
    # scenegen may be vendored into somebody else's repository
    if _git("rev-parse", "--show-toplevel") != str(root):
        return "unknown"
    return _git("describe", "--always", "--dirty=+", "--abbrev=12") or "unknown"


def _git(*words: str) -> str:
    try:
        folder = Path(__file__).resolve().parent
        return subprocess.run(
            ["git", *words], cwd=folder, capture_output=True, text=True, check=False
        ).stdout.strip()
    except OSError:  # git is not installed
        return ""
