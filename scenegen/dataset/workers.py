"""Local processes that work off tasks, and end with their parent whatever ends it.

No threads, queues or locks of the parent's are involved, so that a signal may end it at any point without a deadlock.
"""

import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable
from typing import Any, TypeVar

from scenegen.errors import GenerationError

Task = TypeVar("Task")
Result = TypeVar("Result")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(
    function: Callable[[Task], Result], tasks: Iterable[Task], workers: int, on_start: Callable[[], None] = lambda: None
) -> Generator[Result, None, None]:
    """Results of `function` over `tasks`, as they come; in this process where one worker is enough.

    `on_start` is called when all workers have been started: from then on, this process may run threads. Raises
    GenerationError where a worker is killed, and whatever `function` raises. No process is left behind.
    """
    tasks = list(tasks)
    if workers == 1 or len(tasks) <= 1:
        on_start()
        yield from map(function, tasks)
        return
    # forked workers share the compiled kernels and the imports; elsewhere forking is not safe
    context: Any = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    waiting = iter(tasks)
    busy: list[Any] = []
    try:
        for task in zip(range(workers), waiting):  # noqa: B905 (no more workers than tasks)
            ours, theirs = context.Pipe()
            context.Process(target=_serve, args=(function, theirs, os.getpid()), daemon=True).start()
            theirs.close()
            ours.send(task[1])
            busy.append(ours)
        on_start()
        while busy:
            ready: list[Any] = multiprocessing.connection.wait(busy)
            for worker in ready:
                result = _receive(worker, workers)
                following = next(waiting, None)
                if following is None:
                    busy.remove(worker)
                else:
                    worker.send(following)
                yield result
    finally:
        children = multiprocessing.active_children()
        for child in children:
            child.terminate()
        for child in children:
            child.join(5)
            child.kill()
            child.join()


def _receive(worker: Any, workers: int) -> Any:
    """A worker's result, or its exception raised here."""
    try:
        succeeded, value = worker.recv()
    except (EOFError, ConnectionResetError):
        raise GenerationError(
            "a worker process was killed (out of memory?); finished shards are kept: give the same command again to go "
            f"on, with fewer --workers than {workers} if it happens again"
        ) from None
    if not succeeded:
        raise value
    return value


def _serve(function: Callable[[Any], Any], parent: Any, parent_id: int) -> None:
    """Work off the tasks that come through the pipe `parent` until that process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    threading.Thread(target=_watch, args=(parent_id,), daemon=True).start()
    while True:
        try:
            answer = True, function(parent.recv())
        except EOFError:
            return
        except Exception as error:
            answer = False, error
        parent.send(answer)


def _watch(parent_id: int) -> None:
    while os.getppid() == parent_id:
        time.sleep(0.2)
    os._exit(1)
