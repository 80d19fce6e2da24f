"""Tasks on a Ray cluster (https://docs.ray.io/en/latest/ray-core/tasks.html).

Function and tasks are sent as bytes to a wrapper that is pickled by value. A node without scenegen,
or with another version, can therefore run the wrapper and report the problem. Errors return as
values that name the node. Ray's tasks are used instead of Ray Data to control order and memory.
Usage reporting is disabled before Ray is imported.
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

from scenegen.base.errors import GenerationError, as_own_code_error, needs
from scenegen.base.executors import LOCATED, Begun, Executor, Function, Results, identity
from scenegen.base.workers import safe_path

GO_ON = "what is written is kept: give the same command again to go on"
"""Advice when a task cannot be finished."""


TaskOutcome = tuple[Any, str]
"""Outcome of a remote task: its result and ""; or its exception and the machine's name. A machine
without our scenegen returns a text in place of an exception."""


def taken(value: Any, node: str) -> Any:
    """Unwrap a `TaskOutcome`.

    Args:
        value: The result, or the exception or text of a failure.
        node: "" for a result, or the machine that failed.

    Returns:
        The result.

    Raises:
        Exception: the exception of the outcome, with the machine's name appended.
    """
    if not node:
        return value
    error = GenerationError(value) if isinstance(value, str) else value
    error.args = (f"{error} (on {node})",)
    raise error


def pack(value: Any, pickler: type[pickle.Pickler] = pickle.Pickler) -> bytes:
    """Pickle a value for other machines. The local copy of a remote dataset is sent by name, and
    opened there.

    Args:
        value: The value.
        pickler: Pickler class, such as cloudpickle's.
    """

    class Packer(pickler):  # type: ignore[misc, valid-type]
        def persistent_id(self, item: Any) -> Any:
            return LOCATED.get(item) if isinstance(item, Path) else None

    file = io.BytesIO()
    Packer(file).dump(value)
    return file.getvalue()


def _unpack(packed: bytes) -> Any:
    class Unpacker(pickle.Unpickler):
        def persistent_load(self, pid: Any) -> Path:
            open_dataset, *name = pid
            return open_dataset(*name)

    return Unpacker(io.BytesIO(packed)).load()


def sent(
    function: Callable[[Any], Any], pickler: type[pickle.Pickler] = pickle.Pickler
) -> Callable[[bytes], TaskOutcome]:
    """Wrap a function for remote calls with packed tasks.

    cloudpickle pickles the wrapper by value, since it is a nested function; so the remote machine
    needs no scenegen to call it.

    Args:
        function: Applied to each task.
        pickler: Pickler class for `function`.

    Returns:
        A function from a packed task to a `TaskOutcome`.
    """
    folder = str(Path.cwd())
    command = pack(function, pickler), identity(), folder, folder in sys.path

    def call_remote(task: bytes) -> TaskOutcome:
        try:
            # imported here: as a global, it would be needed to unpickle this function, and a
            # machine without scenegen could not report that
            from scenegen.base.ray import received

            return received(task, *command)
        except ImportError as error:
            from socket import gethostname

            fix = "have the same scenegen, with its extras, on every node"
            return f"no task can be done: {error}; {fix}", gethostname()

    return call_remote


def received(
    task: bytes, parcel: bytes, sender: dict[str, Any], folder: str, importable: bool
) -> TaskOutcome:
    """Run a task on the machine that it was sent to.

    Args:
        task: The packed task.
        parcel: The packed function.
        sender: `identity` of the sender. A machine with another identity refuses.
        folder: Working directory of the sender, used here if it exists.
        importable: Whether modules may be imported from that folder: the user named one in it.

    Returns:
        The `TaskOutcome`.

    Raises:
        ImportError: if a package is not installed here.
    """
    try:
        # compared before anything is unpickled, which needs the sender's own code
        local = identity()
        if local != sender:
            mismatches = [
                f"{key} {local.get(key)}, not {expected}"
                for key, expected in sender.items()
                if local[key] != expected
            ]
            raise GenerationError(
                f"another scenegen there than here: {', '.join(mismatches)}; have the same on "
                f"every node; {GO_ON}"
            )
        with suppress(OSError):
            # so that relative paths of the command lead to the same files
            os.chdir(folder)
        if importable and folder not in sys.path:
            sys.path.append(folder)  # last, as the registry does
        return _function(parcel)(_unpack(task)), ""
    except ImportError:
        raise  # the wrapper of `sent` turns it into advice
    except Exception as error:  # raised again by `taken` on the machine that started the run
        return as_own_code_error(error), socket.gethostname()


@lru_cache(maxsize=1)
def _function(parcel: bytes) -> Callable[[Any], Any]:
    """Unpack the function of a parcel. Cached, so that all tasks of a process share one object and
    whatever it caches."""
    return _unpack(parcel)


def task_name(task: Any) -> str:
    """Name of a task for messages: its file, if it has one."""
    return str(getattr(task, "file", task))[:200]


SILENT = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS": "0"}
"""Environment variables for Ray."""
MAX_RETRIES = 5
"""How often a task is repeated if its node or process is lost."""
AHEAD = 2
"""Tasks submitted per core of the cluster: one runs, one waits."""


class Ray(Executor):
    """Tasks on a Ray cluster.

    ``ray://host:port`` is an existing cluster, ``ray://auto`` the one that this machine belongs to.
    Without an address, a cluster with `workers` cores is started on this machine and stopped
    afterwards. Every node needs the same scenegen, and the command's files at the same paths.
    """

    def __init__(self, address: str, workers: int):
        # before the import, at which Ray reads them
        os.environ.update(SILENT)
        try:
            import ray
        except ImportError:
            raise GenerationError(f"--on ray: {needs('ray', 'ray')}") from None
        self.ray = ray
        self.address, self.workers = address, workers

    def __call__(self, function: Function, tasks: Sequence[Any], on_start: Begun) -> Results:
        """Connect if necessary, and run the tasks; see `Executor`."""
        begun = self._connect()
        try:
            with _silence() if begun else nullcontext():
                yield from self._run(function, tasks, on_start)
        finally:
            if begun:
                self.ray.shutdown()

    def _connect(self) -> bool:
        """Connect to the cluster. Returns False if this process was connected before."""
        ray, address = self.ray, self.address
        if ray.is_initialized():
            return False
        if address in ("", "local"):
            options = {"address": "local", "num_cpus": self.workers, "include_dashboard": False}
        elif address == "auto":
            options = {"address": "auto"}
        elif find_spec("grpc") is None:  # Ray's own line advises another package
            raise GenerationError(f"--on ray://{address}: {needs('grpcio', 'ray')}")
        else:
            options = {"address": f"ray://{address}"}
        try:
            # workers would import from the driver's working directory first
            with safe_path(), chdir("/"):
                ray.init(
                    log_to_driver=False, logging_level="ERROR", configure_logging=False, **options
                )
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            reason = str(error).splitlines()[0]
            raise GenerationError(
                f"--on ray://{address}: no cluster answers there ({reason})"
            ) from None
        return True

    def _run(self, function: Function, tasks: Sequence[Any], on_start: Begun) -> Results:
        ray = self.ray
        pickler = ray.cloudpickle.CloudPickler
        remote = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(sent(function, pickler))
        waiting = collections.deque(tasks)
        submitted: dict[Any, Any] = {}
        on_start()
        try:
            while waiting or submitted:
                # asked again each time, since clusters grow and shrink
                max_submitted = max(AHEAD * int(ray.cluster_resources().get("CPU", 1)), 1)
                while waiting and len(submitted) < max_submitted:
                    task = waiting.popleft()
                    submitted[remote.remote(pack(task, pickler))] = task
                finished, _ = ray.wait(list(submitted), num_returns=1)
                for reference in finished:
                    task = submitted.pop(reference)
                    try:
                        outcome = ray.get(reference)
                    except ray.exceptions.RayError as error:
                        reason = str(error).splitlines()[0]
                        raise GenerationError(
                            f"{task_name(task)}: lost {MAX_RETRIES + 1} times with its process or "
                            f"node ({reason}); {GO_ON}"
                        ) from None
                    yield taken(*outcome)
        finally:
            for reference in submitted:
                # without force, a task that runs would be waited for
                ray.cancel(reference, force=True)


@contextmanager
def _silence() -> Iterator[None]:
    """Keep Ray from printing the log of a lost node.

    It prints on standard output, where a command's result goes, and no setting of Ray prevents
    this. The affected tasks report the loss.
    """
    from ray._private import worker

    original = getattr(worker, "print_to_stdstream", None)
    worker.print_to_stdstream = lambda *args, **options: None
    try:
        yield
    finally:
        worker.print_to_stdstream = original
