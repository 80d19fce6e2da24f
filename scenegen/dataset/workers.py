"""Local processes that write shards, and end with their parent whatever ends it."""

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from scenegen.errors import GenerationError

Task = TypeVar("Task")
Result = TypeVar("Result")


def run(
    function: Callable[[Task], Result], tasks: Iterable[Task], workers: int, on_start: Callable[[], None] = lambda: None
) -> Generator[Result, None, None]:
    """Results of `function` over `tasks`, as they come; in this process where one worker is enough.

    `on_start` is called when all workers have been started: from then on, this process may run threads.

    Raises GenerationError where a worker is killed, and whatever `function` raises. No process is left behind.
    """
    tasks = list(tasks)
    if workers == 1 or len(tasks) <= 1:
        on_start()
        yield from map(function, tasks)
        return
    # forked workers share the compiled kernels and the imports; elsewhere forking is not safe
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    pool = ProcessPoolExecutor(min(workers, len(tasks)), context, _enter, (os.getpid(),))
    try:
        futures = [pool.submit(function, task) for task in tasks]
        on_start()
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool:
        raise GenerationError(
            "a worker process was killed (out of memory?); finished shards are kept: give the same command again to go "
            f"on, with fewer --workers than {workers} if it happens again"
        ) from None
    finally:
        children = multiprocessing.active_children()
        for process in children:
            process.terminate()
        for process in children:
            process.join(5)
            process.kill()
        pool.shutdown(wait=True, cancel_futures=True)


def _enter(parent: int) -> None:
    """Make this process end with `parent`, and leave Ctrl-C to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)
