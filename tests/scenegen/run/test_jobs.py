"""What is asked of Slurm, on a stand-in for it and for submitit; test_slurm.py has the real
ones."""

import os
import pickle
import subprocess
import sys
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from scenegen.errors import DatasetError, GenerationError, OwnCodeError
from scenegen.run import executor
from tests.command_line import ROOT
from tests.scenegen.conftest import wait_for

MOST = 3
"""The cluster's MaxArraySize."""
COMMANDS = {
    "scontrol": f"echo 'MaxArraySize            = {MOST}'",
    "squeue": "",
    "scancel": 'echo "$@" >> cancelled',
}


class UncompletedJobError(RuntimeError):
    """Submitit's, by which it ends what Slurm's signal interrupts."""


class Submitit(SimpleNamespace):
    """The module, as far as it is used: jobs are done when they are submitted."""

    core = SimpleNamespace(utils=SimpleNamespace(UncompletedJobError=UncompletedJobError))
    arrays: list[tuple[int, dict[str, Any]]]
    """The size of each array, and its parameters."""

    def SlurmExecutor(self, folder):  # noqa: N802
        given = {}

        def map_array(function, parts):
            if len(parts) > MOST:
                raise RuntimeError(
                    "sbatch: error: Batch job submission failed: Invalid job array specification"
                )
            self.arrays.append((len(parts), dict(given)))
            return [
                SimpleNamespace(
                    job_id=f"{len(self.arrays)}_{n}",
                    paths=SimpleNamespace(result_pickle=folder),
                    result=partial(function, part),
                )
                for n, part in enumerate(parts)
            ]

        return SimpleNamespace(update_parameters=given.update, map_array=map_array)


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A folder to stand in, where there are Slurm's commands."""
    for name, line in COMMANDS.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{line}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    found = Submitit(arrays=[])
    monkeypatch.setitem(sys.modules, "submitit", found)
    monkeypatch.setitem(sys.modules, "cloudpickle", SimpleNamespace(CloudPickler=pickle.Pickler))
    return found


def test_an_array_is_no_larger_than_the_cluster_takes(slurm, tmp_path):
    """All tasks are done, in arrays that share the workers, and none is left."""
    found = executor("slurm://cpu?time=60&mem=4G", 5)(abs, range(-50, 0), lambda: None)
    assert sorted(found) == list(range(1, 51))
    sizes, (given, *_) = zip(*slurm.arrays, strict=True)
    assert sizes == (3, 3, 3, 3, 3, 2)
    assert given["time"] == 60
    assert given["additional_parameters"] == {"partition": "cpu", "mem": "4G"}
    assert given["array_parallelism"] == 1
    assert (tmp_path / "cancelled").read_text() == f"--name={given['job_name']}\n"
    assert not list(tmp_path.glob("scenegen-slurm-*"))


@pytest.mark.parametrize("minutes", ["1:00:00", "0", "9" * 99])
def test_a_time_limit_is_in_whole_minutes(slurm, minutes):
    with pytest.raises(DatasetError, match="the time in whole minutes"):
        executor(f"slurm://?time={minutes}", 1)


def interrupted(error):
    raise error("Job not requeued because: timed-out and not checkpointable.")


@pytest.mark.parametrize("error", [UncompletedJobError, OwnCodeError])
def test_a_time_limit_that_is_reached_is_one_line(slurm, error):
    with pytest.raises(GenerationError, match=r"job 1_0: timed-out: its 60 minutes are too few"):
        list(executor("slurm://?time=60", 1)(interrupted, [error], lambda: None))


CANCELLED = """
import time
from scenegen.run.slurm import _cancelled
with _cancelled("ours"):
    print("begun", flush=True)
    time.sleep(60)
"""


def test_jobs_are_cancelled_though_the_command_is_killed(slurm, tmp_path):
    environment, said = os.environ | {"PYTHONPATH": str(ROOT)}, tmp_path / "cancelled"
    words = [sys.executable, "-c", CANCELLED]
    with subprocess.Popen(words, stdout=subprocess.PIPE, env=environment) as running:
        assert running.stdout.readline() == b"begun\n"
        assert not said.exists()
        running.kill()
    wait_for(lambda: said.exists() and said.read_text())
    assert said.read_text() == "--name=ours\n"
