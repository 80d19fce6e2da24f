"""A Ray cluster: one task of ours is one of Ray's
(https://docs.ray.io/en/latest/ray-core/tasks.html).

Ray's own tasks, and not Ray Data: their order and memory are ours. Its reporting of usage is off
before it is imported.
"""

import collections
import os
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, nullcontext
from importlib.util import find_spec
from typing import Any

from scenegen.errors import GenerationError, needs
from scenegen.run import Begun, Executor, Function, Results
from scenegen.run.remote import GO_ON, named, pack, sent, taken
from scenegen.run.workers import safe_path

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
