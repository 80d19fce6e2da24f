"""Where the shards of a dataset are written changes nothing of it."""

import marshal
import socket
import subprocess
import sys

import pytest

from scenegen.base.errors import GenerationError
from scenegen.base.executors import executor, identity
from scenegen.base.ray import sent, taken
from scenegen.base.workers import rank_of
from scenegen.dataset.build import build
from tests.conftest import COUNTS, contents, plan_of
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.base.backwards import Backwards


def plan(folder):
    return plan_of(folder, seed=5, counts=COUNTS, shard_samples=3)


def make(folder, place="local"):
    """The digest of a small dataset made at `place`, and all its files."""
    summary = build(plan(folder), execute=executor(place, 1))
    return summary.digest, contents(folder)


def test_ranks_make_a_dataset_together_in_any_order(tmp_path, monkeypatch):
    """Each job writes its own shards and no others; whichever ends last completes the manifest."""
    whole = make(tmp_path / "whole")
    monkeypatch.setenv("SCENEGEN_WORLD_SIZE", "3")
    written = set()
    for rank in (2, 0, 1):
        monkeypatch.setenv("SCENEGEN_RANK", str(rank))
        digest, files = make(tmp_path / "parts", "rank")
        shards = {name for name in files if name.endswith(".h5")}
        assert len(shards - written) in (2, 3)
        written = shards
        assert (digest is None) == (rank != 1)
    assert make(tmp_path / "parts", "rank") == whole


@each_case("base/executors_ranks", "environment rank")
def test_the_environment_tells_the_rank_or_one_line_says_why_not(environment, rank):
    variables = dict(pair.split("=") for pair in environment.split())
    if rank:
        assert str(rank_of(variables)) == rank
    else:
        refuses(environment, rank_of, variables)


@each_case("base/executors", "place")
def test_what_is_no_executor_is_refused(place):
    refuses(place, executor, place, 1)


def test_a_machine_with_another_scenegen_refuses_and_says_what_it_has(tmp_path, monkeypatch):
    theirs = identity() | {"numpy": "1.0", "source": "f00d"}

    def arrive(samples):
        """From here on, this process is the other machine's."""
        monkeypatch.setattr("scenegen.base.ray.identity", lambda: theirs)

    ours = identity()
    with pytest.raises(GenerationError) as caught:
        build(plan(tmp_path / "d"), execute=Backwards("", 1), on_start=arrive)
    said = str(caught.value)
    assert f"numpy 1.0, not {ours['numpy']}, source f00d, not {ours['source']};" in said
    assert said.endswith(f"(on {socket.gethostname()})")
    assert "mujoco" not in said
    assert not list((tmp_path / "d").glob("*.h5"))


BARE = """
import marshal, sys, types
code, cells = marshal.load(sys.stdin.buffer)
closure = tuple(types.CellType(cells[name]) for name in code.co_freevars)
task = types.FunctionType(code, {"__builtins__": __builtins__}, None, None, closure)
print(*task(b""), sep="\\n")
"""


def test_a_machine_without_scenegen_says_so():
    """What is sent needs nothing of ours: its code is run by a Python that has no packages."""
    there = sent(abs)
    cells = {
        name: cell.cell_contents
        for name, cell in zip(there.__code__.co_freevars, there.__closure__, strict=True)
    }
    words = [sys.executable, "-I", "-S", "-c", BARE]
    given = marshal.dumps((there.__code__, cells))
    said, node = subprocess.check_output(words, input=given).decode().splitlines()
    assert node == socket.gethostname()
    with pytest.raises(GenerationError) as caught:
        taken(said, node)
    assert "No module named 'scenegen'; " in str(caught.value)
    assert str(caught.value).endswith(f"(on {node})")
