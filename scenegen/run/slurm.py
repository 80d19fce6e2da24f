"""A Slurm cluster: job arrays, submitted by submitit
(https://github.com/facebookincubator/submitit).

The command stays where it was given, submits, and waits. A job works off several tasks one after
the other: to begin one takes seconds.
"""

import math
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from scenegen.errors import DatasetError, GenerationError, OwnCodeError, needs, printable
from scenegen.run import Begun, Executor, Function, Results, chunked
from scenegen.run.remote import GO_ON, Outcome, pack, sent, taken
from scenegen.run.workers import safe_path

MINUTES = 240
"""How long a job may take unless the address says otherwise."""
MOST_JOBS = 8000
"""The most jobs of a run: Slurm's own MaxJobCount is 10,000, of all users together."""
JOBS = 4
"""Jobs for every one of the workers, so that none waits long for the last."""
MOST_IN_ARRAY = 1001
"""Jobs of one array, where the cluster does not tell its own limit: Slurm's own."""
WAIT_S = 2.0
"""Seconds between two looks at what has ended."""
TIMED_OUT = "timed-out"
"""What submitit says in the error that it raises in a task shortly before the job's time is
over."""
QUEUED_AGAIN = "['scontrol', 'requeue', "
"""What the error says that submitit raises in a task whose job it has queued again, before a
preemption, if Slurm ends that call together with the job."""
LOOKS = 10
"""After how many a job counts as lost that is no longer queued, and whose result is not there."""


class Slurm(Executor):
    """Tasks on a Slurm cluster: `workers` jobs run at a time, one core each. The address,
    ``slurm://PARTITION?time=60&mem=4G``, may name the partition, and options of sbatch.

    Every node needs this Python, scenegen, the files that a command names and the working folder by
    the same paths.
    """

    def __init__(self, address: str, workers: int):
        try:
            import submitit
        except ImportError:
            raise GenerationError(f"--on slurm: {needs('submitit', 'slurm')}") from None
        self.submitit = submitit
        partition, _, options = address.partition("?")
        try:
            given = dict(parse_qsl(options, strict_parsing=bool(options)))
            self.minutes = int(given.pop("time", MINUTES))
            if not 0 < self.minutes < 10**7:
                raise ValueError
        except ValueError:
            raise DatasetError(
                f"--on slurm://{printable(address)[:100]}: expected "
                "slurm://PARTITION?time=60&mem=4G, the time in whole minutes"
            ) from None
        self.options = ({"partition": partition} if partition else {}) | given
        self.workers = workers

    def __call__(self, function: Function, tasks: Sequence[Any], on_start: Begun) -> Results:
        """Submit arrays of jobs, each of which does several tasks, and wait for them."""
        if not tasks:
            on_start()
            return
        each = math.ceil(len(tasks) / min(JOBS * self.workers, MOST_JOBS))
        folder = Path(tempfile.mkdtemp(prefix="scenegen-slurm-", dir=Path.cwd()))
        with _cancelled(folder.name):
            jobs = self._submit(folder, function, chunked(tasks, each))
            on_start()
            for job in self._ended(jobs, folder):
                yield from self._results(job, folder)
            shutil.rmtree(folder)

    def _submit(
        self, folder: Path, function: Function, parts: Sequence[Sequence[Any]]
    ) -> list[Any]:
        """A job for each of `parts`: in one array, or in as many of one size as the cluster asks
        for, which share the workers."""
        from cloudpickle import CloudPickler  # which submitit needs

        there = sent(function, CloudPickler)

        def several(tasks: Sequence[bytes]) -> list[Outcome]:  # sent whole, as `there` is
            """What came of `tasks`, up to the first that failed."""
            found = []
            for task in tasks:
                found.append(there(task))
                if found[-1][1]:
                    if QUEUED_AGAIN in str(found[-1][0]):
                        raise SystemExit  # no result: the job begins again
                    break
            return found

        jobs: list[Any] = []
        try:
            arrays = math.ceil(len(parts) / _most_in_array())
            size = math.ceil(len(parts) / arrays)
            executor = self.submitit.SlurmExecutor(folder=folder)
            executor.update_parameters(
                job_name=folder.name,
                cpus_per_task=1,
                array_parallelism=math.ceil(self.workers / arrays),
                stderr_to_stdout=True,
                time=self.minutes,  # of submitit's own, which counts with it
                additional_parameters=self.options,
            )
            with safe_path():  # the jobs' environment is this one; they are begun by python -m
                for array in chunked(parts, size):
                    # packed one after the other: a task may be 4 KB
                    packed = [[pack(task, CloudPickler) for task in part] for part in array]
                    jobs += executor.map_array(several, packed)
            return jobs
        except (RuntimeError, OSError) as error:
            shutil.rmtree(folder, ignore_errors=True)
            raise GenerationError(
                f"--on slurm: nothing could be submitted ({_last_line(str(error))})"
            ) from None

    def _ended(self, jobs: list[Any], folder: Path) -> Results:
        """The jobs as their results come. Raises GenerationError for one that left the queue
        without any.

        Slurm's accounting, which submitit would ask, is not there on every cluster.
        """
        looks = dict.fromkeys((job.job_id for job in jobs), 0)
        while jobs:
            queued = _queued(folder.name)
            for job in list(jobs):
                if job.paths.result_pickle.exists():
                    jobs.remove(job)
                    yield job
                elif queued is not None and job.job_id not in queued:
                    looks[job.job_id] += 1  # a shared disk may show the result a little later
                    if looks[job.job_id] > LOOKS:
                        log = job.paths.stdout  # where Slurm names the node, if it began the job
                        said = log.read_text(errors="replace") if log.exists() else ""
                        said = _last_line(said) or "it was cancelled, or killed"
                        raise _lost(job.job_id, f"left the queue without a result: {said}", folder)
            time.sleep(WAIT_S if jobs else 0)

    def _results(self, job: Any, folder: Path) -> Results:
        try:
            for outcome in job.result():
                yield taken(*outcome)
        except (self.submitit.core.utils.UncompletedJobError, OwnCodeError) as error:
            said = _last_line(str(error))
            if TIMED_OUT in str(error):  # in whatever code the signal met the task
                said = f"{TIMED_OUT}: its {self.minutes} minutes are too few"
                said += ", give more as slurm://…?time="
            elif isinstance(error, OwnCodeError):
                raise
            raise _lost(job.job_id, said, folder) from None


def _lost(job: str, reason: str, folder: Path) -> GenerationError:
    return GenerationError(f"--on slurm: job {job}: {reason}; see {folder}; {GO_ON}")


def _last_line(text: str) -> str:
    """The last line of a log, or of an error."""
    return printable(text.strip().rpartition("\n")[2])[:200]


@contextmanager
def _cancelled(run: str) -> Iterator[None]:
    """Have all jobs called `run`, and no others, cancelled when the block ends, or this process,
    even if it is killed: a process of its own waits for the end of a pipe that nobody else
    holds."""
    words = ["/bin/sh", "-c", 'read end; exec scancel --name="$0"', run]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, start_new_session=True
    ):
        yield


def _told(words: str) -> "subprocess.CompletedProcess[str]":
    """What one of Slurm's commands says."""
    return subprocess.run(words.split(), capture_output=True, text=True)


def _most_in_array() -> int:
    """The cluster's MaxArraySize."""
    found = re.search(r"^MaxArraySize\s*=\s*(\d+)", _told("scontrol show config").stdout, re.M)
    return max(int(found[1]), 1) if found else MOST_IN_ARRAY


def _queued(run: str) -> set[str] | None:
    """The jobs of a run that wait or run, by their ids; None where Slurm does not answer now."""
    done = _told(f"squeue --noheader --array --format=%i --name={run}")
    return None if done.returncode else set(done.stdout.split())
