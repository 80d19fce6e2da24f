"""Results made by worker processes before they are asked for, for as long as anybody asks."""

import multiprocessing.connection
import os
import sys
import weakref
from collections import deque
from collections.abc import Callable
from typing import Any, Generic

from scenegen.errors import GenerationError
from scenegen.run.workers import MOST_REPLACED, Result, Task, Worker


class Ahead(Generic[Task, Result]):
    """`workers` processes that work off tasks in the order in which they are given. They end with
    this object, and with this process whatever ends it; one that dies is replaced, and its tasks
    are given again."""

    def __init__(self, function: Callable[[Task], Result], workers: int):
        self._function, self._count, self._died = function, workers, 0
        self._start = "fork" if sys.platform == "linux" else "spawn"
        self._workers = [Worker(function, self._start) for _ in range(workers)]
        self._given: list[deque[Task]] = [deque() for _ in range(workers)]
        self._done: dict[Task, tuple[bool, Any]] = {}
        # unlike a `__del__`, it runs at exit before the modules that it needs are gone
        self.close = weakref.finalize(self, _end, self._workers, os.getpid())
        """End the processes, whatever they are doing."""

    @property
    def under_way(self) -> int:
        """Tasks that were given, and whose results nobody took."""
        return len(self._done) + sum(map(len, self._given))

    def __contains__(self, task: object) -> bool:
        return task in self._done or any(task in given for given in self._given)

    def give(self, task: Task) -> None:
        """Have a result made; a task that is under way is not given again."""
        if task not in self:
            worker = min(range(self._count), key=lambda n: len(self._given[n]))
            self._given[worker].append(task)
            self._send(worker, task)

    def take(self, task: Task) -> Result:
        """The result of a task, as soon as it is there. Raises what the function raises, and
        GenerationError where processes die again and again."""
        self.give(task)
        self.collect()
        while task not in self._done:
            self.collect(wait=True)
        succeeded, value = self._done.pop(task)
        if not succeeded:
            raise value
        return value

    def collect(self, *, wait: bool = False) -> None:
        """Take in what is finished, or, with `wait`, at least one thing."""
        pipes = {worker.pipe: n for n, worker in enumerate(self._workers)}
        for pipe in multiprocessing.connection.wait(list(pipes), None if wait else 0):
            number = pipes[pipe]
            try:
                answer = self._workers[number].pipe.recv()
            except (EOFError, OSError):
                self._replace(number)
                continue
            self._done[self._given[number].popleft()] = answer

    def _send(self, number: int, task: Task) -> None:
        try:
            self._workers[number].pipe.send(task)
        except OSError:
            self._replace(number)

    def _replace(self, number: int) -> None:
        """Another process in the place of one that died."""
        self._died += 1
        if self._died > MOST_REPLACED:
            raise GenerationError(
                f"stream: worker processes were killed {self._died} times (out of memory?); give "
                f"fewer than "
                f"{self._count}"
            )
        self._workers[number].end()
        self._workers[number] = Worker(self._function, self._start)
        for task in self._given[number]:
            self._workers[number].pipe.send(task)


def _end(workers: list[Worker], process: int) -> None:
    if process == os.getpid():  # not in a fork, whose parent's they are
        for worker in workers:
            worker.end()
    workers.clear()
