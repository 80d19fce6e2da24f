"""Executors elsewhere: what is sent to other machines, what comes back, and tasks of a Ray cluster
(https://docs.ray.io/en/latest/ray-core/tasks.html).

Function and tasks are sent as bytes, to a function that is itself sent whole: a node that lacks
scenegen, or has another one, can call it and say so. Errors come back as values, and tell the node.
Ray's own tasks are used, and not Ray Data: their order and memory are ours. Its reporting of usage
is off before it is imported.
"""

import collections
import io
import os
import pickle
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, contextmanager, nullcontext, suppress
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from scenegen.base.errors import GenerationError, needs, told
from scenegen.base.executors import LOCATED, Begun, Executor, Function, Results, identity
from scenegen.base.workers import safe_path

GO_ON = "what is written is kept: give the same command again to go on"
"""What to do where a task is lost for good."""


Outcome = tuple[Any, str]
"""What became of a task on another machine: the result, and ""; or the exception and the machine
that raised it, a text in place of the exception where the machine has no scenegen of ours."""


def taken(value: Any, node: str) -> Any:
    """The result of an `Outcome`. Raises its exception, which names the node."""
    if not node:
        return value
    error = GenerationError(value) if isinstance(value, str) else value
    error.args = (f"{error} (on {node})",)
    raise error


def pack(value: Any, pickler: type[pickle.Pickler] = pickle.Pickler) -> bytes:
    """`value` as bytes for other machines. A dataset's folder that `locate` found by a name goes as
    that name, for each machine to open: what was copied here is not there."""

    class Packer(pickler):  # type: ignore[misc, valid-type]
        def persistent_id(self, item: Any) -> Any:
            return LOCATED.get(item) if isinstance(item, Path) else None

    file = io.BytesIO()
    Packer(file).dump(value)
    return file.getvalue()


def _unpack(packed: bytes) -> Any:
    class Unpacker(pickle.Unpickler):
        def persistent_load(self, pid: Any) -> Path:
            open_there, *name = pid
            return open_there(*name)

    return Unpacker(io.BytesIO(packed)).load()


def sent(
    function: Callable[[Any], Any], pickler: type[pickle.Pickler] = pickle.Pickler
) -> Callable[[bytes], Outcome]:
    """`function` as it is sent, for tasks that are packed.

    Pickled by value, as cloudpickle does with functions within functions, it needs no scenegen.
    """
    folder = str(Path.cwd())
    command = pack(function, pickler), identity(), folder, folder in sys.path

    def there(task: bytes) -> Outcome:
        try:
            # `there` is sent by value: what it names, it imports
            from scenegen.base.ray import received

            return received(task, *command)
        except ImportError as error:
            from socket import gethostname

            fix = "have the same scenegen, with its extras, on every node"
            return f"no task can be done: {error}; {fix}", gethostname()

    return there


def received(
    task: bytes, parcel: bytes, sender: dict[str, Any], folder: str, importable: bool
) -> Outcome:
    """What comes of a task, on the machine that it was sent to.

    Args:
        task: The task, packed.
        parcel: The function, packed.
        sender: The `identity` of the scenegen that sent both; another one does nothing.
        folder: Where the command was given. The task is done there, if the folder is here, too.
        importable: Whether modules are imported from that folder: a user named one in it.

    Raises:
        ImportError: Something is not installed here.
    """
    try:
        own = identity()
        if own != sender:
            odd = [
                f"{key} {own.get(key)}, not {it}" for key, it in sender.items() if own[key] != it
            ]
            raise GenerationError(
                f"another scenegen there than here: {', '.join(odd)}; have the same on every node; "
                f"{GO_ON}"
            )
        with suppress(OSError):
            os.chdir(folder)
        if importable and folder not in sys.path:
            sys.path.append(folder)  # last, as the registry does
        return _function(parcel)(_unpack(task)), ""
    except ImportError:
        raise
    except Exception as error:  # whatever it is, it is raised where the run was begun
        return told(error), socket.gethostname()


@lru_cache(maxsize=1)
def _function(parcel: bytes) -> Callable[[Any], Any]:
    """The function of a parcel: one object for all tasks of a process, for it may keep something
    from one to the next."""
    return _unpack(parcel)


def named(task: Any) -> str:
    """What a task is about: its file, where it has one."""
    return str(getattr(task, "file", task))[:200]


SILENT = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS": "0"}
"""What Ray's environment says wherever we begin it."""
MOST_TRIES = 5
"""How often a task may begin anew whose node or process was lost."""
AHEAD = 2
"""Tasks given away for every core of the cluster: one that runs, and one that waits."""


class Ray(Executor):
    """Tasks on a Ray cluster.

    With an address, ``ray://host:port``, or ``ray://auto`` for the cluster that this machine is of,
    a cluster that is there; else one that is begun on this machine, of `workers` cores, and ended
    afterwards. Every node needs scenegen, of this version, and the files that a command names by
    the same paths.
    """

    def __init__(self, address: str, workers: int):
        os.environ.update(SILENT)
        try:
            import ray
        except ImportError:
            raise GenerationError(f"--on ray: {needs('ray', 'ray')}") from None
        self.ray = ray
        self.address, self.workers = address, workers

    def __call__(self, function: Function, tasks: Sequence[Any], on_start: Begun) -> Results:
        """Connect, where this process is not connected yet, and have the tasks done."""
        begun = self._connect()
        try:
            with _silence() if begun else nullcontext():
                yield from self._run(function, tasks, on_start)
        finally:
            if begun:
                self.ray.shutdown()

    def _connect(self) -> bool:
        """Whether this process was not connected before."""
        ray, where = self.ray, self.address
        if ray.is_initialized():
            return False
        if where in ("", "local"):
            there = {"address": "local", "num_cpus": self.workers, "include_dashboard": False}
        elif where == "auto":
            there = {"address": "auto"}
        elif find_spec("grpc") is None:  # Ray's own line advises another package
            raise GenerationError(f"--on ray://{where}: {needs('grpcio', 'ray')}")
        else:
            there = {"address": f"ray://{where}"}
        try:
            with safe_path(), chdir("/"):  # the workers import from where the driver stands, first
                ray.init(
                    log_to_driver=False, logging_level="ERROR", configure_logging=False, **there
                )
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            reason = str(error).splitlines()[0]
            raise GenerationError(
                f"--on ray://{where}: no cluster answers there ({reason})"
            ) from None
        return True

    def _run(self, function: Function, tasks: Sequence[Any], on_start: Begun) -> Results:
        ray = self.ray
        pickler = ray.cloudpickle.CloudPickler
        remote = ray.remote(num_cpus=1, max_retries=MOST_TRIES)(sent(function, pickler))
        waiting = collections.deque(tasks)
        given: dict[Any, Any] = {}
        on_start()
        try:
            while waiting or given:
                most = max(AHEAD * int(ray.cluster_resources().get("CPU", 1)), 1)
                while waiting and len(given) < most:
                    task = waiting.popleft()
                    given[remote.remote(pack(task, pickler))] = task
                done, _ = ray.wait(list(given), num_returns=1)
                for one in done:
                    task = given.pop(one)
                    try:
                        outcome = ray.get(one)
                    except ray.exceptions.RayError as error:
                        reason = str(error).splitlines()[0]
                        raise GenerationError(
                            f"{named(task)}: lost {MOST_TRIES + 1} times with its process or node "
                            f"({reason}); {GO_ON}"
                        ) from None
                    yield taken(*outcome)
        finally:
            for one in given:
                ray.cancel(one, force=True)


@contextmanager
def _silence() -> Iterator[None]:
    """Keep Ray from printing the log of a node that it lost: on standard output, where a command's
    result goes. What that costs the run, its tasks tell. No setting of Ray's does this."""
    from ray._private import worker

    said = getattr(worker, "print_to_stdstream", None)
    worker.print_to_stdstream = lambda *given, **named: None
    try:
        yield
    finally:
        worker.print_to_stdstream = said
