"""What a command gives wherever it is done: a dataset, a network, the commands, and what they
leave."""

import json
import shutil

import torch

from scenegen.model.checkpoint import save_network
from scenegen.model.config import NetworkConfig
from scenegen.model.network import Network
from tests.command_line import run
from tests.conftest import contents, dataset_in
from tests.scenegen import cases

COUNTS = {"train": 4, "val": 2, "test": 4}
SAMPLES = sum(COUNTS.values())
COMMANDS = [line.split() for (line,) in cases("base/everywhere")]
*_, COMPLETE, BENCH = COMMANDS


def make(folder):
    """`d`, a dataset of five shards, and `n.safetensors`, a network for it."""
    grid = dataset_in(folder / "d", seed=5, counts=COUNTS, shard_samples=3).grid
    torch.manual_seed(0)
    save_network(
        folder / "n.safetensors", Network(NetworkConfig(width=2, height=grid.shape[2])), grid, {}
    )


def stand(folder, monkeypatch):
    """Stand in `folder`, with tasks of two samples."""
    monkeypatch.chdir(folder)
    torch.set_num_threads(1)
    monkeypatch.setattr("scenegen.convert.convert.CHUNK", 2)
    monkeypatch.setattr("scenegen.model.bench.run.CHUNK", 2)
    monkeypatch.setattr("scenegen.model.completion.predictions.PART", 2)


def outcome(capsys, here, words, out, *more):
    """What the command leaves at `out`, or says; without times, and without its own words."""
    writes = () if words[0] == "verify" else ("-o", out)
    code, said, complaint = run(capsys, *words, *writes, *more)
    assert code == 0, complaint
    if words[0] == "verify":
        return checks(said)
    found = contents(here / out)
    if words[0] == "bench":
        found = json.loads(found["report.json"])
        found.pop("command")
    shutil.rmtree(here / out, ignore_errors=True)
    (here / out).unlink(missing_ok=True)
    return found


def checks(said):
    """A report's checks by name, without their time."""
    return {check.pop("name"): check | {"seconds": 0} for check in json.loads(said)["checks"]}
