"""Processes of this machine that work off tasks, and end with their parent whatever ends it.

`run` is all that most need; `guarded` calls a library that a stranger's bytes may crash. No
threads, queues or locks of the parent's are involved, so that a signal may end it at any point
without a deadlock.
"""

import contextlib
import math
import multiprocessing
import multiprocessing.connection
import os
import resource
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from scenegen.base.errors import (
    DatasetError,
    GenerationError,
    GuardError,
    ScenegenError,
    short,
    told,
    whole_number,
)
from scenegen.base.executors import Begun, Executor, Function, Results, undone_if_stopped
from scenegen.base.limits import MOST_WORKERS

PR_SET_PDEATHSIG = 1
"""Linux's name for it."""
WATCH_S = 2.0
"""How often a process that has nothing to do looks whether its parent is still there, seconds."""
MOST_REPLACED = 5
"""Workers that may die in a run with limits before the rest is given up."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""The C library's names for the most free memory that it keeps, and the least that it takes from
the system apart."""
SAFE_PATH = "PYTHONSAFEPATH"
"""Where this is set, Python looks for no modules in the working folder unless it is told to."""
RANKS = (
    ("SCENEGEN_RANK", "SCENEGEN_WORLD_SIZE"),
    ("JOB_COMPLETION_INDEX", "SCENEGEN_WORLD_SIZE"),
    ("RANK", "WORLD_SIZE"),
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT"),
    ("SLURM_PROCID", "SLURM_NTASKS"),
)
"""Where rank and world size stand in the environment; the first pair that is there counts. What the
user set, for an indexed Job of Kubernetes the size alone, comes first. Then torchrun, which begins
several processes in one of Slurm's tasks; then Slurm's own job arrays and tasks."""


class Local(Executor):
    """Processes of this machine. Raises DatasetError for an address, and for `workers` below 1."""

    def __init__(self, address: str, workers: int):
        if address:
            name = type(self).__name__.lower()
            raise DatasetError(f"--on {name}://{address}: takes no address; give --on {name}")
        self.workers = whole_number("--workers", workers, 1, MOST_WORKERS)

    def __call__(self, function: Function, tasks: Sequence[Any], on_start: Begun) -> Results:
        """Apply `function` to `tasks`, see `run`."""
        return run(function, tasks, self.workers, on_start)


ALONE = Local("", 1)
"""This process."""


class Rank(Local):
    """One of many jobs that are the same but for their rank, begun by something else: it does every
    world-size-th task, from its rank on.

    Raises DatasetError where an address is given, and where the environment tells no rank.
    """

    def __init__(self, address: str, workers: int):
        super().__init__(address, workers)
        self.rank, self.size = rank_of(os.environ)

    def mine(self, tasks: Sequence[Any]) -> Sequence[Any]:
        """Those of all tasks that are this job's."""
        return tasks[self.rank :: self.size]


def rank_of(environment: Mapping[str, str]) -> tuple[int, int]:
    """Rank, from 0, and world size. Raises DatasetError where `environment` does not tell both, or
    impossible ones."""
    names = next((pair for pair in RANKS if set(pair) <= environment.keys()), None)
    if names is None:
        ways = ", or ".join(" and ".join(pair) for pair in RANKS)
        raise DatasetError(f"--on rank: the environment tells no rank; set {ways}")
    given = [environment[name] for name in names]
    # the least number of a job array need not be 0
    first = environment.get("SLURM_ARRAY_TASK_MIN", "0") if "ARRAY" in names[0] else "0"
    if all(value.isascii() and value.isdigit() for value in given):
        rank, size = int(given[0]) - int(first), int(given[1])
        if 0 <= rank < size:
            return rank, size
    raise DatasetError(
        f"--on rank: {names[0]}={short(given[0])}, {names[1]}={short(given[1])}; expected whole "
        "numbers, the first from 0 to one less than the second"
    )


def keep_memory() -> None:
    """Have up to 64 MB of freed memory stay with this process and those that it begins, for the
    next shard takes as much: pages that are given back and taken anew cost the system time
    (docs/log). For programs, not libraries."""
    import ctypes

    library = ctypes.CDLL(None)
    library.mallopt(M_MMAP_THRESHOLD, 32 << 20)
    library.mallopt(M_TRIM_THRESHOLD, 64 << 20)


@dataclass(frozen=True)
class Limited:
    """A function of tasks whose input nobody vouches for: it never runs in this process, and may
    crash or hang in its own. `run` sees to that, and so does calling it."""

    function: Function
    seconds: Callable[[Any], float]
    """How long a task may take."""
    memory_bytes: int
    """Address space a worker may take beyond what it starts with, where the system can limit it."""
    given_up: Callable[[Any, str], Any]
    """The result of a task whose worker died, or was ended for taking too long: made of the task
    and what happened."""

    def __call__(self, task: Any) -> Any:
        """The result, from a process that is kept for this thread's next task: for executors that
        call functions in processes of their own, which may run threads."""
        worker = vars(_kept).pop("worker", None) or Worker(self, "spawn")
        if worker.limits is not self or not worker.process.is_alive():
            worker.end()
            worker = Worker(self, "spawn")
        with contextlib.ExitStack() as ended:
            ended.callback(worker.end)
            worker.give(task)
            _ready([worker])
            result = worker.take(1)
            if worker.alive:
                ended.pop_all()
                _kept.worker = worker
        return result


_kept = threading.local()
"""Holds as `worker` the process of the function with limits that this thread called last, if there
is one. It is of no use to other threads: it ends with the thread that began it, see
`die_with_parent`; and of none to a process that is forked, whose child it is not."""
_begins = threading.RLock()
"""Held while a process is begun, by a changed environment or a changed flag of this one."""
os.register_at_fork(after_in_child=lambda: vars(_kept).clear())
os.register_at_fork(after_in_child=_begins._at_fork_reinit)  # type: ignore[attr-defined]


def run(
    function: Function, tasks: Iterable[Any], workers: int, on_start: Begun = lambda: None
) -> Results:
    """Results of `function` over `tasks`, as they come; in this process where one worker is enough
    and `function` is not `Limited`.

    `on_start` is called when all workers have been started: from then on, this process may run
    threads. Raises GenerationError where a worker is killed, unless `function` is `Limited`, and
    whatever `function` raises. No process is left behind.
    """
    waiting = deque(tasks)
    if not isinstance(function, Limited) and (workers == 1 or len(waiting) <= 1):
        on_start()
        yield from map(function, waiting)
        return
    busy: list[Worker] = []
    deaths = 0
    with undone_if_stopped(lambda: _kill(busy)):
        try:
            while waiting and len(busy) < workers:
                busy.append(Worker(function))
                busy[-1].give(waiting.popleft())
            on_start()
            while busy:
                for worker in _ready(busy):
                    result = worker.take(workers)
                    deaths += not worker.alive
                    more = waiting and (worker.alive or deaths <= MOST_REPLACED)
                    if not (more and worker.alive):
                        busy.remove(worker)
                        worker.end()
                        if more:  # by now there may be threads, so that this one is not forked
                            worker = Worker(function, "spawn")
                            busy.append(worker)
                    if more:
                        worker.give(waiting.popleft())
                    yield result
            for task in waiting:
                assert isinstance(function, Limited)
                yield function.given_up(task, "was not examined: too many before it failed")
        finally:
            for worker in busy:
                worker.end()


def guarded(function: Function, task: Any, *, seconds: float, memory_bytes: int) -> Any:
    """`function(task)`, computed in a process of its own that may take `seconds` and `memory_bytes`
    more than this one.

    For libraries that a stranger's bytes could make hang, crash or take all memory: what they do
    happens elsewhere, and only the result, which must be picklable, comes back. Costs some 10 ms.
    The process is a fork: a library's pool of threads that was begun before does not exist in it,
    so that `function` must have the library work on one thread, or begin a pool of its own.
    Raises the ScenegenError that `function` raises, and GuardError where the process ends in any
    other way.
    """
    alone = Limited(
        partial(_outcome, function),
        lambda _: seconds,
        memory_bytes,
        lambda _, reason: GuardError(reason),
    )
    (outcome,) = run(alone, [task], 1)
    if isinstance(outcome, ScenegenError):
        raise outcome
    return outcome[0]


def _outcome(function: Function, task: Any) -> tuple[Any] | ScenegenError:
    """The result of a function, or its ScenegenError."""
    try:
        return (function(task),)
    except ScenegenError as error:
        return error


class Worker:
    """One process, the task that it has, and how long it may still take. A forked one shares the
    compiled kernels and the imports; one that is spawned may begin while threads run here."""

    def __init__(self, function: Function, start: str = "fork"):
        context: Any = multiprocessing.get_context(start)
        self.pipe, theirs = context.Pipe()
        self.limits = limits = function if isinstance(function, Limited) else None
        given = (function, None) if limits is None else (limits.function, limits.memory_bytes)
        # the kernel would take the end of another thread than the main one for that of its parent
        bound = limits is not None or threading.current_thread() is threading.main_thread()
        self.process = context.Process(
            target=_serve, args=(*given, theirs, os.getpid(), bound), daemon=True
        )
        here = multiprocessing.current_process()
        with _begins, contextlib.nullcontext() if start == "fork" else safe_path():
            daemon, here.daemon = here.daemon, False  # which may begin none; ours end with it
            try:
                self.process.start()
            finally:
                here.daemon = daemon
        theirs.close()
        self.alive = True

    def give(self, task: Any) -> None:
        """Have a task worked off; its time begins."""
        seconds = self.limits.seconds(task) if self.limits else math.inf
        self._task, self._deadline = task, time.monotonic() + seconds
        self.pipe.send(task)

    @property
    def seconds_left(self) -> float:
        """For the task that was given last."""
        return max(self._deadline - time.monotonic(), 0.0)

    def take(self, workers: int) -> Any:
        """The task's result, or its exception raised here; with limits, what stands for one that
        did not come."""
        value: Any
        try:
            succeeded, value = self.pipe.recv() if self.pipe.poll() else (False, None)
        except (EOFError, ConnectionResetError):
            self.alive = False
            if self.limits is None:
                raise GenerationError(
                    "a worker process was killed (out of memory?); finished shards are kept: give "
                    f"the same command again to go on, with fewer --workers than {workers} if it "
                    "happens again"
                ) from None
            reason = "ended its process: it crashed, or took too much memory"
        else:
            if succeeded:
                return value
            if self.limits is None:
                raise value
            self.alive = value is not None
            said = " ".join(str(value).split())[:200]
            reason = f"ended in {type(value).__name__}: {said}" if self.alive else "took too long"
        return self.limits.given_up(self._task, reason)

    def end(self) -> None:
        """Whatever it is doing."""
        self.process.terminate()
        self.process.join(5)
        self.process.kill()
        self.process.join()
        self.pipe.close()


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """While the block runs, a Python that this process starts imports nothing from the working
    folder.

    Multiprocessing starts its processes by ``python -c``, which would look there first, for
    `multiprocessing` itself (https://docs.python.org/3/using/cmdline.html#envvar-PYTHONSAFEPATH). A
    spawned process gets this one's `sys.path`.
    """
    with _begins:  # or a thread would take for the user's what another one set
        before = os.environ.get(SAFE_PATH)
        os.environ[SAFE_PATH] = "1"
        try:
            yield
        finally:
            if before is None:
                del os.environ[SAFE_PATH]
            else:
                os.environ[SAFE_PATH] = before


def _kill(busy: list[Worker]) -> None:
    """End all at once, for a process that ends itself next."""
    for worker in busy:
        worker.process.kill()
    for worker in busy:
        worker.process.join(1)


def _ready(busy: list[Worker]) -> list[Worker]:
    """Workers that have a result, have died, or have run out of time."""
    least = min(worker.seconds_left for worker in busy)
    pipes = multiprocessing.connection.wait(
        [worker.pipe for worker in busy], None if least == math.inf else least
    )
    return [worker for worker in busy if worker.pipe in pipes or worker.seconds_left == 0.0]


def limit_memory(more_bytes: int) -> None:
    """Let this process grow by so much and no further."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * os.sysconf("SC_PAGE_SIZE") + more_bytes
    with contextlib.suppress(ValueError):  # the user's own limit is lower
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


def _serve(
    function: Function, memory_bytes: int | None, parent: Any, parent_id: int, bound: bool
) -> None:
    """Work off the tasks that come through the pipe `parent` until that process ends: at once if
    `bound` to the thread that began this one, or after the task under way."""
    if memory_bytes is not None:
        limit_memory(memory_bytes)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    if bound:
        die_with_parent()
    # its end of the pipe may be held open by other forks of the parent
    while os.getppid() == parent_id:
        if not parent.poll(WATCH_S):
            continue
        try:
            answer = True, function(parent.recv())
        except EOFError:
            return
        except Exception as error:
            answer = False, told(error)  # which alone knows of the traceback
        parent.send(answer)


def die_with_parent() -> None:
    """Have the kernel end this process when the thread that began it ends, even if it hangs in a
    library then."""
    import ctypes

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
