"""Executors: where tasks run, and the software that runs them. `workers` has the processes of this
machine, `ray` has clusters.

What one task gives depends on the task alone, so what a command makes of them has the same bits
wherever they run.
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
from scenegen.base.errors import ScenegenError, raised_as

Function = Callable[[Any], Any]
"""What is applied to each task."""
Begun = Callable[[], None]
"""What is called once the work has begun."""
Results = Generator[Any, None, None]
"""Results as they come."""
Counted = Callable[[int], None]
"""What is told how many samples there are, or that so many more are done."""


LOCATED: dict[Path, tuple[Any, ...]] = {}
"""Folders of this machine that were found by a name with a scheme: for each, a function that finds
it on another machine, and its arguments, the name first."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def chunked(items: Sequence[Any], size: int) -> list[Any]:
    """`items` in their order, cut into parts of `size`; the last may be shorter."""
    return [items[first : first + size] for first in range(0, len(items), size)]


def unheard(samples: int) -> None:
    """Where nobody wants to be told."""


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
    """Yield the results of `tasks` as they come, and report progress.

    Args:
        execute: Where the tasks run.
        function: What is applied to each task.
        tasks: The tasks.
        total: The number of samples in all tasks.
        on_start: Called with `total` once the work has begun.
        on_done: Called with the number of samples of each result.
        size: Gives the number of samples of a result.
    """
    with closing(execute(function, tasks, lambda: on_start(total))) as results:
        for result in results:
            on_done(size(result))
            yield result


class Executor(Protocol):
    """A place where tasks run, made of an `address`, "" for none, and of the number of `workers`
    asked for."""

    def __init__(self, address: str, workers: int) -> None: ...

    def mine(self, tasks: Sequence[Any]) -> Sequence[Any]:
        """Those of all `tasks` of a run, done or not, that are for this process to see to: all,
        unless it says so."""
        return tasks

    def __call__(self, function: Function, tasks: Sequence[Any], on_start: Begun) -> Results:
        """Have `function` applied to `tasks`, and yield the results as they come, in any order.

        Closing the generator ends what it began, and only that.

        Args:
            function: Can be pickled, as the tasks can. Files that they name are reached from
                everywhere, but for copies of a store's: `scenegen.base.ray` sends its name
                instead, and has nodes that have another scenegen refuse.
            tasks: What it is applied to.
            on_start: Called once the work has begun.

        Raises:
            GenerationError: A task is lost for good. Whatever `function` raises is raised, too.
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
"""The one that serves where none is named."""


def executor(place: str, workers: int) -> Executor:
    """The executor called `place`, a name with an address or without: ``ray://10.0.0.1:10001``.

    Raises ScenegenError for a name that leads to none, and what making it raises.
    """
    name, _, address = place.partition("://")
    with raised_as(ScenegenError, "--on: "):
        return EXECUTORS.find(name)(address, workers)


def check_together(execute: Executor, what: str) -> None:
    """Raise ScenegenError, with `what` it is that takes all results, where an executor leaves tasks
    to other processes."""
    if len(execute.mine((0, 1))) < 2:
        raise ScenegenError(
            f"--on: {what} all results, and jobs that know their rank alone bring none together; "
            "give --on ray, or each job work of its own with --on local"
        )


_begun: list[Callable[[], object]] = []


@contextmanager
def undone_if_stopped(undo: Callable[[], object]) -> Iterator[None]:
    """While the block runs, `undo_all` calls `undo`, which must be quick and wait for nobody, and
    may return a line to say of the stop."""
    _begun.append(undo)
    try:
        yield
    finally:
        _begun.remove(undo)


@contextmanager
def undone(undo: Callable[[], object]) -> Iterator[None]:
    """Call `undo` when the block ends, in whatever way, also as `undone_if_stopped`."""
    with undone_if_stopped(undo):
        try:
            yield
        finally:
            undo()


def undo_all() -> str:
    """Undo what is begun and not finished, the latest first, for a process that ends at once:
    drafts are removed, workers ended. Returns what is to be said of it; "" for nothing."""
    line = ""
    for undo in reversed(_begun):
        with suppress(Exception):  # what cannot be undone must not keep the rest
            said = undo()
            line = said if isinstance(said, str) else line
    return line


PACKAGES = ("mujoco", "ompl", "numpy", "numba", "trimesh")
"""What the numbers depend on besides scenegen itself."""


def software() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    found = {"scenegen": scenegen.__version__, "machine": platform.machine()}
    return found | {package: installed(package) for package in PACKAGES}


def processor() -> str:
    """What this machine's processor is called."""
    with suppress(OSError):  # elsewhere than on Linux
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "CPU"


@cache
def installed(package: str) -> str:
    """The installed version of a package, or ``absent``."""
    from importlib.metadata import (
        PackageNotFoundError,
        version,
    )  # which takes longer than reading a manifest

    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


@cache
def identity() -> dict[str, Any]:
    """What two machines must have in common whose tasks become one result: `software`, the
    generator, and a digest of every Python file of both packages. Worked out once a process."""
    digest = hashlib.sha256()
    for path in sources(*(Path(str(package.__file__)).parent for package in (lidarsim, scenegen))):
        digest.update(path.read_bytes())
    return software() | {"generator": scenegen.GENERATOR, "source": digest.hexdigest()[:12]}


def commit() -> str:
    """The checkout's commit, with a + where it has changes; ``unknown`` outside of one, or in
    another project's."""
    here = Path(__file__).resolve().parents[2]
    if _git("rev-parse", "--show-toplevel") != str(here):
        return "unknown"
    return _git("describe", "--always", "--dirty=+", "--abbrev=12") or "unknown"


def _git(*words: str) -> str:
    try:
        here = Path(__file__).resolve().parent
        return subprocess.run(
            ["git", *words], cwd=here, capture_output=True, text=True, check=False
        ).stdout.strip()
    except OSError:  # git is not installed
        return ""
