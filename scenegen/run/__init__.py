"""Executors: where tasks run. One file an executor; each fills `Executor`.

What one task gives depends on the task alone, so what a command makes of them has the same bits
wherever they run.
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any, Protocol

from lidarsim.registry import Registry
from scenegen.errors import ScenegenError


class Executor(Protocol):
    """A place where tasks run, made of an `address`, "" for none, and of the number of `workers`
    asked for."""

    def __init__(self, address: str, workers: int) -> None: ...

    def mine(self, tasks: Sequence[Any]) -> Sequence[Any]:
        """Those of all `tasks` of a run, done or not, that are for this process to see to: all,
        unless it says so."""
        return tasks

    def __call__(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], on_start: Callable[[], None]
    ) -> Generator[Any, None, None]:
        """Have `function` applied to `tasks`, and yield the results as they come, in any order.

        `on_start` is called once the work has begun. `function` and tasks can be pickled; files
        that they name are reached from everywhere, but for copies of a place:
        `scenegen.run.remote` sends its name instead, and has nodes that have another scenegen
        refuse. Closing the generator ends what it began, and only that. Raises GenerationError
        where a task is lost for good, and whatever `function` raises.
        """
        ...


EXECUTORS = Registry(
    "executor",
    {
        "local": "scenegen.run.local:Local",
        "rank": "scenegen.run.local:Rank",
        "ray": "scenegen.run.ray:Ray",
        "slurm": "scenegen.run.slurm:Slurm",
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
    try:
        found = EXECUTORS.find(name)
    except ValueError as error:
        raise ScenegenError(f"--on: {error}") from None
    made: Executor = found(address, workers)
    return made
