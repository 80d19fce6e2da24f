"""A Slurm cluster: job arrays, submitted by submitit (https://github.com/facebookincubator/submitit).

The command stays where it was given, submits, and waits. A job works off several tasks one after the other: to begin
one takes seconds.
"""

import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from scenegen.errors import DatasetError, GenerationError, needs, printable
from scenegen.executors import Executor
from scenegen.executors.remote import GO_ON, Outcome, attempt
from scenegen.stopping import undone_if_stopped

MINUTES = 240
"""How long a job may take unless the address says otherwise."""
JOBS = 4
"""Jobs for every one of the workers, so that none waits long for the last."""
WAIT_S = 2.0
"""Seconds between two looks at what has ended."""
LOOKS = 10
"""After how many a job counts as lost that is no longer queued, and whose result is not there."""


class Slurm(Executor):
    """See `Executor`. `workers` jobs run at a time, one core each. The address, ``slurm://PARTITION?time=60&mem=4G``,
    may name the partition, and options of sbatch.

    Every node needs this Python, scenegen, the files that a command names and the working folder by the
    same paths.
    """

    def __init__(self, address: str, workers: int):
        try:
            import submitit
        except ImportError:
            raise GenerationError(f"--on slurm: {needs('submitit', 'slurm')}") from None
        self.submitit = submitit
        partition, _, options = address.partition("?")
        try:
            given = dict(parse_qsl(options, strict_parsing=True)) if options else {}
        except ValueError:
            raise DatasetError(
                f"--on slurm://{printable(address)[:100]}: expected slurm://PARTITION?time=60&mem=4G"
            ) from None
        self.options = ({"partition": partition} if partition else {}) | given
        self.workers = workers

    def __call__(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], on_start: Callable[[], None]
    ) -> Generator[Any, None, None]:
        """See `Executor`."""
        if not tasks:
            on_start()
            return
        each = math.ceil(len(tasks) / (JOBS * self.workers))
        folder = Path(tempfile.mkdtemp(prefix="scenegen-slurm-", dir=Path.cwd()))
        cancel = ["scancel", f"--name={folder.name}"]  # this run's jobs, and no others
        with undone_if_stopped(lambda: subprocess.Popen(cancel, start_new_session=True)):
            try:
                jobs = self._submit(folder, function, [tasks[n : n + each] for n in range(0, len(tasks), each)])
                on_start()
                for job in self._ended(jobs, folder):
                    for outcome in self._outcomes(job, folder):
                        yield outcome.taken()
                shutil.rmtree(folder)
            except BaseException:
                with suppress(FileNotFoundError):  # no Slurm here, as the error says
                    subprocess.run(cancel, check=False)
                raise

    def _submit(self, folder: Path, function: Callable[[Any], Any], parts: Sequence[Sequence[Any]]) -> list[Any]:
        """One job of the array for each of `parts`."""
        try:
            executor = self.submitit.SlurmExecutor(folder=folder, max_num_timeout=3)
            own = {name: value for name, value in self.options.items() if name not in ("partition", "time", "mem")}
            executor.update_parameters(
                job_name=folder.name,
                cpus_per_task=1,
                array_parallelism=self.workers,
                stderr_to_stdout=True,
                time=self.options.get("time", MINUTES),
                **{name: self.options[name] for name in ("partition", "mem") if name in self.options},
                additional_parameters=own,
            )
            return list(executor.map_array(partial(_several, function, Path.cwd()), parts))
        except (RuntimeError, self.submitit.core.utils.FailedJobError) as error:
            reason = printable(str(error).strip().splitlines()[-1])
            raise GenerationError(f"--on slurm: nothing could be submitted ({reason})") from None

    def _ended(self, jobs: list[Any], folder: Path) -> Generator[Any, None, None]:
        """The jobs as their results come. Raises GenerationError for one that left the queue without any.

        Slurm's accounting, which submitit would ask, is not there on every cluster.
        """
        looks = dict.fromkeys((job.job_id for job in jobs), 0)
        while jobs:
            queued = _queued(jobs[0].job_id.partition("_")[0])
            for job in list(jobs):
                if job.paths.result_pickle.exists():
                    jobs.remove(job)
                    yield job
                elif job.job_id not in queued:
                    looks[job.job_id] += 1  # a shared disk may show the result a little later
                    if looks[job.job_id] > LOOKS:
                        raise _lost(job.job_id, "left the queue without a result: cancelled, or killed", folder)
            time.sleep(WAIT_S if jobs else 0)

    def _outcomes(self, job: Any, folder: Path) -> list[Outcome]:
        try:
            return list(job.result())
        except (self.submitit.core.utils.UncompletedJobError, self.submitit.core.utils.FailedJobError) as error:
            raise _lost(job.job_id, printable(str(error).strip().splitlines()[0])[:200], folder) from None


def _lost(job: str, reason: str, folder: Path) -> GenerationError:
    return GenerationError(f"--on slurm: job {job}: {reason}; see {folder}; {GO_ON}")


def _queued(array: str) -> set[str]:
    """The jobs of an array that wait or run, each as array_index."""
    words = ["squeue", "--noheader", "--array", "--format=%i", f"--jobs={array}"]
    found = subprocess.run(words, capture_output=True, text=True, check=False)  # which fails once all have ended
    return set(found.stdout.split())


def _several(function: Callable[[Any], Any], here: Path, tasks: Sequence[Any]) -> list[Outcome]:
    """What came of `tasks`, up to the first that failed."""
    found = []
    for task in tasks:
        found.append(attempt(function, task, here))
        if found[-1].node:
            break
    return found
