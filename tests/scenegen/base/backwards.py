"""Executors for tests: what other machines do to tasks, done in this process."""

import os
import pickle
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from scenegen.base.errors import GenerationError
from scenegen.base.executors import Executor
from scenegen.base.ray import _function, pack, sent, taken
from scenegen.dataset.locate import locate_again


class Backwards(Executor):
    """Function, tasks and results travel as bytes, and the last task is done first."""

    def __init__(self, address, workers):
        self.most = int(address) if address else None
        """How many tasks are done before the rest is lost."""

    machine: Any = nullcontext
    """Another machine, while a task is done."""

    def __call__(self, function, tasks, on_start):
        """See `Executor`."""
        there = sent(function)
        on_start()
        try:
            for number, task in enumerate(reversed(tasks)):
                if number == self.most:
                    raise GenerationError(f"{task}: lost with its node")
                given = pack(task)
                with self.machine():
                    found = pickle.dumps(there(given))
                yield taken(*pickle.loads(found))
        finally:
            _function.cache_clear()  # another machine's process would have ended


class Bare(Backwards):
    """The same, on a machine where nothing lies that was copied from places here."""

    @contextmanager
    def machine(self):
        ours = Path(os.environ["SCENEGEN_CACHE"]) / "scenegen" / "places"
        kept, theirs = ours.with_name("kept"), ours.with_name("theirs")
        ours.rename(kept)
        if theirs.exists():
            theirs.rename(ours)
        locate_again.cache_clear()
        try:
            yield
        finally:
            with suppress(FileNotFoundError):  # nothing of a place was read
                ours.rename(theirs)
            kept.rename(ours)


def die_of_one(task):
    """Stands for `examine` in a library that one file of a stranger's brings down."""
    from scenegen.verification.folder import examine

    if task.file == "test-00001.h5":
        os.kill(os.getpid(), 9)
    return examine(task)
