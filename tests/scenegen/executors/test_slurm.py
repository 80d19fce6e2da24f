"""On a real Slurm, begun on this machine: the same bits, and one line for what goes wrong.

python -m pytest -m slow tests/scenegen/executors/test_slurm.py
    needs the extra `slurm`, Debian's slurm-wlm and munge, and to be root: it begins munged, slurmctld and slurmd
"""

import os
import shutil
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
from tests.scenegen.executors import slurm_here

pytest.importorskip("submitit")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("slurmctld") is None or os.getuid() != 0, reason="needs slurm-wlm, and to be root"),
]
COUNTS = {"train": 24, "val": 3, "test": 3}


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, int]]:
    """A cluster of two nodes, both this machine."""
    with slurm_here.slurm(tmp_path_factory.mktemp("slurm"), nodes=2) as nodes:
        yield nodes


def plan(folder: Path) -> Any:
    recipe = small_recipe()
    return plan_dataset(folder, recipe, DrawnWorlds(recipe), seed=5, counts=COUNTS, shard_samples=3)


@pytest.fixture
def here(slurm: dict[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
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
