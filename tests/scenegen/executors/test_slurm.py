"""On a real Slurm, begun on this machine: the same bits, and one line for what goes wrong.

python -m pytest -m slow tests/scenegen/executors/test_slurm.py
    needs the extra `slurm`, Debian's slurm-wlm and munge, and to be root: it begins munged, slurmctld and slurmd
"""

import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scenegen.dataset import manifest
from scenegen.dataset.build import build, plan_dataset
from scenegen.errors import DatasetError, GenerationError, ScenegenError
from scenegen.executors import executor
from scenegen.source import DrawnWorlds
from tests.conftest import small_recipe

pytest.importorskip("submitit")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("slurmctld") is None or os.getuid() != 0, reason="needs slurm-wlm, and to be root"),
]
COUNTS = {"train": 24, "val": 3, "test": 3}
CONFIG = """
ClusterName=scenegen
SlurmctldHost={host}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
SlurmUser=root
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
JobCompType=jobcomp/none
ReturnToService=2
MpiDefault=none
SchedulerParameters=sched_interval=1
NodeName={host} CPUs={cpus} State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A cluster of this machine; its folder."""
    folder = tmp_path_factory.mktemp("slurm")
    for above in (folder, *folder.parents):  # munge refuses sockets in folders that others cannot reach
        if above.stat().st_uid == 0 and above != Path("/"):
            above.chmod(above.stat().st_mode | 0o755)
    (folder / "state").mkdir()
    (folder / "spool").mkdir()
    host = socket.gethostname().split(".")[0]
    text = CONFIG.format(host=host, folder=folder, ports=(free_port(), free_port()), cpus=os.cpu_count())
    (folder / "slurm.conf").write_text(text)
    (folder / "key").write_bytes(os.urandom(1024))
    (folder / "key").chmod(0o400)
    before = os.environ.get("SLURM_CONF")
    os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
    names = {"key-file": "key", "socket": "munge.socket", "log-file": "log", "pid-file": "pid", "seed-file": "seed"}
    files = [f"--{flag}={folder}/{name}" for flag, name in names.items()]
    daemons = [subprocess.Popen(words) for words in (["munged", "-F", "-f", *files],)]
    time.sleep(1)
    daemons += [subprocess.Popen(words) for words in (["slurmctld", "-D"], ["slurmd", "-D"])]
    try:
        for _ in range(60):
            told = subprocess.run(["sinfo", "-h", "-o", "%T"], capture_output=True, text=True, check=False)
            if told.stdout.strip() in ("idle", "mixed"):
                break
            time.sleep(1)
        else:
            pytest.fail(f"no node is up: {told.stdout}{told.stderr}\n{(folder / 'slurmctld.log').read_text()[-2000:]}")
        yield folder
    finally:
        for daemon in reversed(daemons):
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(20)
        os.environ.pop("SLURM_CONF")
        if before is not None:
            os.environ["SLURM_CONF"] = before


def plan(folder: Path) -> Any:
    recipe = small_recipe()
    return plan_dataset(folder, recipe, DrawnWorlds(recipe), seed=5, counts=COUNTS, shard_samples=3)


@pytest.fixture
def here(slurm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_job_array_makes_the_same_dataset(here: Path) -> None:
    seen: list[bool] = []
    there = build(plan(here / "there"), execute=executor("slurm", 2), on_shard=lambda report, fresh: seen.append(fresh))
    assert there.digest == build(plan(here / "here")).digest
    assert seen == [True] * 10
    for path in (here / "here").iterdir():
        assert (here / "there" / path.name).read_bytes() == path.read_bytes()
    assert not list(here.glob("scenegen-slurm-*")), "nothing is left"


def test_an_error_is_raised_here_names_the_node_and_ends_the_rest(here: Path) -> None:
    with pytest.raises(DatasetError, match=rf"nowhere/0: .* \(on {socket.gethostname()}"):
        list(executor("slurm", 1)(manifest.read, [Path(f"nowhere/{n}") for n in range(6)], lambda: None))
    for _ in range(30):
        left = subprocess.run(["squeue", "-h"], capture_output=True, text=True, check=True).stdout
        if not left:
            break
        time.sleep(1)
    assert left == ""


def test_a_job_that_somebody_cancels_is_told_of(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scenegen.executors.slurm.LOOKS", 2)
    words = ["scancel", "--name=scenegen"]
    with pytest.raises(GenerationError, match=r"job \d+_0: left the queue without a result") as caught:
        list(executor("slurm", 1)(time.sleep, [60, 60], lambda: subprocess.run(words, check=True)))
    assert "\n" not in str(caught.value)


def test_what_slurm_refuses_is_one_line(here: Path) -> None:
    with pytest.raises(GenerationError, match="--on slurm: nothing could be submitted") as caught:
        list(executor("slurm://nowhere", 1)(abs, [0], lambda: None))
    assert "\n" not in str(caught.value)
    with pytest.raises(ScenegenError, match=r"expected slurm://PARTITION\?time=60&mem=4G"):
        executor("slurm://all?time", 1)
