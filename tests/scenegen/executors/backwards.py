"""Executors for tests: what other machines do to tasks, done in this process."""

import os
import pickle
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

from scenegen.errors import GenerationError
from scenegen.executors import Executor
from scenegen.executors.remote import attempt


class Backwards(Executor):
    """Function, tasks and results travel as bytes, and the last task is done first."""

    def __init__(self, address: str, workers: int):
        self.most = int(address) if address else None
        """How many tasks are done before the rest is lost."""

    def __call__(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], on_start: Callable[[], None]
    ) -> Generator[Any, None, None]:
        """See `Executor`."""
        there = pickle.loads(pickle.dumps(function))
        on_start()
        for number, task in enumerate(reversed(tasks)):
            if number == self.most:
                raise GenerationError(f"{task}: lost with its node")
            given = pickle.loads(pickle.dumps(task))
            yield pickle.loads(pickle.dumps(attempt(there, given, Path.cwd()))).taken()


def die_of_one(task: Any) -> Any:
    """Stands for `examine` in a library that one file of a stranger's brings down."""
    from scenegen.verify.shard import examine

    if task.file == "val-00001.h5":
        os.kill(os.getpid(), 9)
    return examine(task)
