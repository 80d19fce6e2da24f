"""Worker processes of this machine, which end when their parent ends, however it ends; and the rank
of one of several equal jobs, from the environment.

`run` serves most callers; `guarded` calls a library that untrusted input may crash. The parent uses
no threads, queues or locks for it, so that a signal may end it anywhere without a deadlock.
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

from lidarsim.parameters import short_repr
from scenegen.base.errors import (
    DatasetError,
    GenerationError,
    GuardError,
    ScenegenError,
    as_own_code_error,
    check_int,
)
from scenegen.base.executors import Begun, Executor, Function, Results, undone_if_stopped
from scenegen.base.limits import MAX_WORKERS

RANKS = (
    ("SCENEGEN_RANK", "SCENEGEN_WORLD_SIZE"),
    ("JOB_COMPLETION_INDEX", "SCENEGEN_WORLD_SIZE"),
    ("RANK", "WORLD_SIZE"),
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT"),
    ("SLURM_PROCID", "SLURM_NTASKS"),
)
"""Environment variables of rank and world size. The first pair that is set counts: the user's own
(for an indexed Job of Kubernetes only the size), then torchrun's, which starts several processes in
a task of Slurm, then Slurm's job arrays and tasks."""


def rank_of(environment: Mapping[str, str]) -> tuple[int, int]:
    """Read rank and world size from the environment.

    Args:
        environment: Environment variables.

    Returns:
        Rank, from 0, and world size.

    Raises:
        DatasetError: if they are missing or invalid.
    """
    names = next((pair for pair in RANKS if set(pair) <= environment.keys()), None)
    if names is None:
        ways = ", or ".join(" and ".join(pair) for pair in RANKS)
        raise DatasetError(f"--on rank: the environment tells no rank; set {ways}")
    values = [environment[name] for name in names]
    # a job array need not start at 0
    first = environment.get("SLURM_ARRAY_TASK_MIN", "0") if "ARRAY" in names[0] else "0"
    if all(value.isascii() and value.isdigit() for value in values):
        rank, size = int(values[0]) - int(first), int(values[1])
        if 0 <= rank < size:
            return rank, size
    raise DatasetError(
        f"--on rank: {names[0]}={short_repr(values[0])}, {names[1]}={short_repr(values[1])}; "
        "expected whole "
        "numbers, the first from 0 to one less than the second"
    )


PR_SET_PDEATHSIG = 1
"""Option of Linux's `prctl`: the signal that this process gets when its parent ends."""
WATCH_S = 2.0
"""Interval at which an idle worker checks that its parent still runs, seconds."""
MAX_REPLACED = 5
"""Maximum number of replaced workers in a `Limited` run. Afterwards its remaining tasks are given
up."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of the C library's `mallopt`: free memory that is kept, and the size from which on a
block is mapped by itself."""
SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable that keeps Python from importing modules from the working directory."""


class Local(Executor):
    """Processes of this machine. Raises DatasetError if there is an address, or `workers` is below
    1."""

    def __init__(self, address: str, workers: int):
        if address:
            name = type(self).__name__.lower()
            raise DatasetError(f"--on {name}://{address}: takes no address; give --on {name}")
        self.workers = check_int("--workers", workers, 1, MAX_WORKERS)

    def __call__(self, function: Function, tasks: Sequence[Any], on_start: Begun) -> Results:
        """Run the tasks; see `run`."""
        return run(function, tasks, self.workers, on_start)


ALONE = Local("", 1)
"""Runs tasks in this process."""


class Rank(Local):
    """One of many equal jobs that differ in their rank. It takes every n-th task from its rank on,
    where n is the world size.

    Raises:
        DatasetError: if there is an address, or the environment has no rank.
    """

    def __init__(self, address: str, workers: int):
        super().__init__(address, workers)
        self.rank, self.size = rank_of(os.environ)

    def mine(self, tasks: Sequence[Any]) -> Sequence[Any]:
        """The tasks of this job."""
        return tasks[self.rank :: self.size]


def keep_memory() -> None:
    """Keep up to 64 MB of freed memory in this process and its children, as the next shard needs as
    much.

    Returning pages to the system and taking them again costs time (docs/log). For programs, not
    for libraries.
    """
    import ctypes

    library = ctypes.CDLL(None)
    # 32 MB is the most that glibc accepts on 64-bit machines
    library.mallopt(M_MMAP_THRESHOLD, 32 << 20)
    library.mallopt(M_TRIM_THRESHOLD, 64 << 20)


@dataclass(frozen=True)
class Limited:
    """A function of untrusted input with limits on time and memory. `run` and `__call__` execute it
    only in separate processes, which may crash or hang."""

    function: Function
    seconds: Callable[[Any], float]
    """Time limit of a task, seconds."""
    memory_bytes: int
    """Address space that a worker may add to what it starts with, bytes, where the system supports
    a limit."""
    given_up: Callable[[Any, str], Any]
    """Makes the result of a task whose worker died or timed out, from the task and the reason."""

    def __call__(self, task: Any) -> Any:
        """Run one task in a process that is reused for this thread's next task. For executors that
        call functions in their own processes, which may run threads."""
        # kept between tasks, as starting one takes 0.7 to 2.2 s of processor time
        # taken out meanwhile, so that a worker that fails is not used again
        worker = vars(_idle).pop("worker", None) or Worker(self, "spawn")
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
                _idle.worker = worker
        return result


_idle = threading.local()
"""Per thread: the reusable `worker` of its last `Limited` function.

A worker ends with the thread that started it (see `die_with_parent`), so threads do not share it. A
forked process must not use it either, as it is not its child.
"""
_start_lock = threading.RLock()
"""Held while a process is started, since the environment and flags of this process are changed
meanwhile."""
# a fork copies both as they are: the parent's worker, and perhaps a lock that nobody will release
os.register_at_fork(after_in_child=lambda: vars(_idle).clear())
os.register_at_fork(after_in_child=_start_lock._at_fork_reinit)  # type: ignore[attr-defined]


def run(
    function: Function, tasks: Iterable[Any], workers: int, on_start: Begun = lambda: None
) -> Results:
    """Apply a function to tasks, and yield the results in the order in which they finish.

    A single worker, or a single task, runs in this process unless `function` is `Limited`. No
    process is left behind.

    Args:
        function: Applied to each task.
        tasks: The tasks.
        workers: Number of processes.
        on_start: Called when all workers have started. Only then may this process start threads, as
            workers are forked.

    Raises:
        GenerationError: if a worker is killed and `function` is not `Limited`. Errors of `function`
            pass through.
    """
    pending = deque(tasks)
    if not isinstance(function, Limited) and (workers == 1 or len(pending) <= 1):
        on_start()
        yield from map(function, pending)
        return
    busy: list[Worker] = []
    deaths = 0
    with undone_if_stopped(lambda: _kill(busy)):
        try:
            while pending and len(busy) < workers:
                busy.append(Worker(function))
                busy[-1].give(pending.popleft())
            on_start()
            while busy:
                for worker in _ready(busy):
                    result = worker.take(workers)
                    deaths += not worker.alive
                    has_next = pending and (worker.alive or deaths <= MAX_REPLACED)
                    if not (has_next and worker.alive):
                        busy.remove(worker)
                        worker.end()
                        if has_next:  # spawned, as this process may run threads by now
                            worker = Worker(function, "spawn")
                            busy.append(worker)
                    if has_next:
                        worker.give(pending.popleft())
                    yield result
            for task in pending:
                # of any other function, the death of a worker is an error and ends the run
                assert isinstance(function, Limited)
                yield function.given_up(task, "was not examined: too many before it failed")
        finally:
            for worker in busy:
                worker.end()


def guarded(function: Function, task: Any, *, seconds: float, memory_bytes: int) -> Any:
    """Compute `function(task)` in a forked process with limits, and return its result.

    For libraries that untrusted input could make hang, crash or exhaust memory. It costs about 10
    ms. A thread pool that a library started earlier does not exist in the fork: `function` must use
    one thread, or start a new pool.

    Args:
        function: Applied to `task`. Its result is pickled.
        task: The input.
        seconds: Time limit.
        memory_bytes: Address space beyond that of this process.

    Raises:
        GuardError: if the process crashes, times out, or fails in another way.
        ScenegenError: as raised by `function`.
    """
    limited = Limited(
        partial(_outcome, function),
        lambda _: seconds,
        memory_bytes,
        lambda _, reason: GuardError(reason),
    )
    (outcome,) = run(limited, [task], 1)
    if isinstance(outcome, ScenegenError):
        raise outcome
    return outcome[0]


def _outcome(function: Function, task: Any) -> tuple[Any] | ScenegenError:
    """Result of a function, wrapped in a tuple, or the ScenegenError that it raises."""
    try:
        return (function(task),)
    except ScenegenError as error:
        return error


class Worker:
    """One process, its task, and the task's deadline. A forked process shares compiled kernels and
    imports; a spawned one may be started while this process runs threads."""

    # a spawned process runs the user's script again, so fork is the default
    def __init__(self, function: Function, start: str = "fork"):
        context: Any = multiprocessing.get_context(start)
        self.pipe, worker_pipe = context.Pipe()
        self.limits = limits = function if isinstance(function, Limited) else None
        job = (function, None) if limits is None else (limits.function, limits.memory_bytes)
        # The kernel takes the thread that started the process for its parent: a worker that another
        # thread than the main one started would end with that thread.
        dies_with_thread = (
            limits is not None or threading.current_thread() is threading.main_thread()
        )
        self.process = context.Process(
            target=_serve, args=(*job, worker_pipe, os.getpid(), dies_with_thread), daemon=True
        )
        this_process = multiprocessing.current_process()
        with _start_lock, contextlib.nullcontext() if start == "fork" else safe_path():
            # multiprocessing forbids children of daemons; ours are safe, as they end with this one
            daemon, this_process.daemon = this_process.daemon, False
            try:
                self.process.start()
            finally:
                this_process.daemon = daemon
        # while this process holds that end, a worker that dies gives no EOF here
        worker_pipe.close()
        self.alive = True

    def give(self, task: Any) -> None:
        """Send a task. Its time starts now."""
        seconds = self.limits.seconds(task) if self.limits else math.inf
        self._task, self._deadline = task, time.monotonic() + seconds
        self.pipe.send(task)

    @property
    def seconds_left(self) -> float:
        """Time left for the current task, seconds."""
        return max(self._deadline - time.monotonic(), 0.0)

    def take(self, workers: int) -> Any:
        """Receive the result of the current task.

        Args:
            workers: Number of workers of the run, for the message.

        Returns:
            The result; for a `Limited` function that failed, the value of `given_up`.

        Raises:
            GenerationError: if the worker was killed. Errors of the function pass through.
        """
        value: Any
        try:
            # an empty pipe: `_ready` named the worker because its time is over
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
            # a worker that is late still works on its task, so it cannot take another
            self.alive = value is not None
            message = " ".join(str(value).split())[:200]
            reason = (
                f"ended in {type(value).__name__}: {message}" if self.alive else "took too long"
            )
        return self.limits.given_up(self._task, reason)

    def end(self) -> None:
        """End the process, whatever it is doing."""
        self.process.terminate()
        self.process.join(5)
        self.process.kill()
        self.process.join()
        self.pipe.close()


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """While the block runs, keep new Python processes from importing from the working directory.

    Multiprocessing starts processes by ``python -c``, which would search there first, even for
    `multiprocessing` itself (https://docs.python.org/3/using/cmdline.html#envvar-PYTHONSAFEPATH). A
    spawned process gets this one's `sys.path` afterwards.
    """
    with _start_lock:  # otherwise a thread could restore the value that another thread set
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
    """Kill all workers, before this process exits."""
    for worker in busy:
        worker.process.kill()
    for worker in busy:
        worker.process.join(1)


def _ready(busy: list[Worker]) -> list[Worker]:
    """Wait for workers that have a result, have died, or have timed out."""
    timeout_s = min(worker.seconds_left for worker in busy)
    pipes = multiprocessing.connection.wait(
        [worker.pipe for worker in busy], None if timeout_s == math.inf else timeout_s
    )
    return [worker for worker in busy if worker.pipe in pipes or worker.seconds_left == 0.0]


def limit_memory(more_bytes: int) -> None:
    """Limit the address space of this process to its present size plus `more_bytes`."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    max_bytes = pages * os.sysconf("SC_PAGE_SIZE") + more_bytes
    with contextlib.suppress(ValueError):  # the user's own limit is lower
        resource.setrlimit(
            resource.RLIMIT_AS, (max_bytes, resource.getrlimit(resource.RLIMIT_AS)[1])
        )


def _serve(
    function: Function, memory_bytes: int | None, pipe: Any, parent_id: int, dies_with_thread: bool
) -> None:
    """Main loop of a worker: answer tasks from `pipe` until the parent ends.

    With `dies_with_thread`, the kernel ends this process at once when the thread that started it
    ends; otherwise it ends after the current task.
    """
    if memory_bytes is not None:
        limit_memory(memory_bytes)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    # not the parent's handlers, which Python runs only when a library returns
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    if dies_with_thread:
        die_with_parent()
    # EOF alone does not show that the parent ended: other forks may hold its end of the pipe open
    while os.getppid() == parent_id:
        if not pipe.poll(WATCH_S):
            continue
        try:
            answer = True, function(pipe.recv())
        except EOFError:
            return
        except Exception as error:
            answer = (
                False,
                as_own_code_error(error),
            )  # here, as pickling drops the traceback that it reads
        pipe.send(answer)


def die_with_parent() -> None:
    """Have the kernel kill this process when the thread that started it ends, even if it hangs in a
    library."""
    import ctypes

    # a parent that ended before this call sends nothing: `_serve` asks for its id, too
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
