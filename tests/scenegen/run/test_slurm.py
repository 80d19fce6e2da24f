"""On a real Slurm, begun on this machine: the same bits, and one line for what goes wrong.

python -m pytest -m slow tests/scenegen/run/test_slurm.py
    needs the extra `slurm`, Debian's slurm-wlm and munge, and to be root: it begins munged,
    slurmctld and slurmd
"""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from scenegen.dataset import manifest
from scenegen.dataset.build import build
from scenegen.errors import DatasetError, GenerationError
from scenegen.run import executor
from tests.command_line import ROOT, process
from tests.conftest import contents
from tests.scenegen.conftest import wait_for
from tests.scenegen.run import everywhere, slurm_here
from tests.scenegen.run.test_executors import plan

pytest.importorskip("submitit")
pytestmark = [pytest.mark.slow, slurm_here.NEEDED]


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    """A cluster of two nodes, both this machine."""
    with slurm_here.slurm(tmp_path_factory.mktemp("slurm"), nodes=2) as nodes:
        yield nodes


def queue():
    """The jobs that Slurm has."""
    return process("squeue", "-h", "-o", "%i").stdout.split()


@pytest.fixture
def here(slurm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # where jobs find functions of this file
    return tmp_path


def test_a_job_array_makes_the_same_dataset(here):
    seen = []
    how = {"execute": executor("slurm", 2), "on_shard": lambda report, fresh: seen.append(fresh)}
    build(plan(here / "there"), **how)
    build(plan(here / "here"))
    assert seen == [True] * 7
    assert contents(here / "there") == contents(here / "here")
    assert not list(here.glob("scenegen-slurm-*"))  # nothing is left


def test_commands_give_the_same_there(here, monkeypatch, capsys):
    """verify, convert, complete and bench: equal reports, and files byte by byte."""
    everywhere.make(here)
    everywhere.stand(here, monkeypatch)
    for words in everywhere.COMMANDS:
        there = everywhere.outcome(capsys, here, words, "there", "--on", "slurm", "--workers", 2)
        assert there == everywhere.outcome(capsys, here, words, "here", "--workers", 1)


def test_an_error_is_raised_here_names_the_node_and_ends_the_rest(here):
    tasks = [Path(f"nowhere/{n}") for n in range(6)]
    with pytest.raises(DatasetError, match=rf"nowhere/0: .* \(on {socket.gethostname()}"):
        list(executor("slurm", 1)(manifest.read, tasks, lambda: None))
    wait_for(lambda: queue() == [])


def test_a_job_that_somebody_cancels_is_told_of(here, monkeypatch):
    monkeypatch.setattr("scenegen.run.slurm.LOOKS", 2)

    def cancel():
        (folder,) = here.glob("scenegen-slurm-*")
        process("scancel", f"--name={folder.name}")

    with pytest.raises(
        GenerationError, match=r"job \d+_0: left the queue without a result"
    ) as caught:
        list(executor("slurm", 1)(time.sleep, [60, 60], cancel))
    assert "\n" not in str(caught.value)


COMMAND = """
import time
from scenegen.cli import stops
from scenegen.run import executor
stops.answer()
list(executor("slurm", 2)(time.sleep, [60] * 3, lambda: print("begun", flush=True)))
"""


@pytest.mark.parametrize(("stop", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_a_command_that_is_stopped_or_killed_leaves_no_jobs(here, stop, code):
    """Those of this run are cancelled, and no others."""
    other = process("sbatch", "--parsable", "--wrap", "sleep 60").stdout.strip()
    words = [sys.executable, "-c", COMMAND]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout.readline() == "begun\n"
        running.send_signal(stop)
        assert running.wait(20) == code
    wait_for(lambda: queue() == [other])
    process("scancel", other)


def twice(task):
    """Done by the second who tries, and tells its node; the first one's is lost meanwhile."""
    node = os.environ["SLURMD_NODENAME"]
    if list(task.glob("node*")):
        return node
    (task / f"{node} {os.getpid()}").touch()
    time.sleep(120)
    return "was not lost"


def test_a_task_whose_node_is_lost_begins_again_on_another(slurm, here):
    """The last test, for a node is lost. Slurm waits two minutes before a task begins again."""

    def lose():
        """Once the task has begun, its node is told to be down, and all processes there are
        killed."""
        wait_for(lambda: list(here.glob("node*")))
        for name, task in [path.name.split() for path in here.glob("node*")]:
            os.kill(slurm[name], signal.SIGKILL)
            process("scontrol", "update", f"nodename={name}", "state=down", "reason=test")
            os.kill(int(task), signal.SIGKILL)
            lost.append(name)

    lost = []
    losing = threading.Thread(target=lose)
    try:
        (found,) = executor("slurm", 1)(twice, [here], losing.start)
    finally:
        losing.join()
    assert {found, *lost} == slurm.keys()
