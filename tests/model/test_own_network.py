"""A network, a loss and an input of a user's own: the page as it stands, and what a file may not
do."""

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose

from lidarsim import GridSpec
from scenegen import Completer
from scenegen.model.checkpoint import load_tensors, save_tensors
from scenegen.model.config import TrainConfig
from scenegen.model.inputs import input_called
from tests.command_line import done, example, page, run
from tests.model.conftest import saved_network
from tests.model.training.runs import figures, train
from tests.refusals import refuses, refuses_command
from tests.scenegen import each_case

OWN = "my_net:Net,my_input:rise"
pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def here(folders, standing):
    """A user's folder with the page's files, to stand in."""
    for name in ("my_net.py", "my_loss.py", "my_input.py"):
        (standing / name).write_text(example("own-network.md", f"# {name}"))
    (standing / "wrong.py").write_text(WRONG)
    (standing / "data").mkdir()
    (standing / "data" / "pillar").symlink_to(folders[0])
    yield standing
    input_called.cache_clear()


def test_the_page_trains_completes_benches_and_exports(here, capsys):
    lines = re.findall(r"^scenegen .*$", page("own-network.md"), re.MULTILINE)
    commands = [line.split()[1:] for line in lines]
    assert [words[0] for words in commands] == ["train", "complete", "bench", "export", "complete"]
    for words in commands:
        done(capsys, *words)
    with h5py.File("predictions/test-00000.h5") as first, h5py.File("again/test-00000.h5") as again:
        for name in ("occupancy_probability", "tudf"):
            assert_allclose(again[name], first[name], atol=5e-2)
    (opened, *_) = Completer.from_pretrained(f"{OWN}@runs/Net").opened
    assert Completer.from_pretrained(opened).inputs == ("observed", "my_input:rise")
    rows = figures(Path("runs/Net"))
    assert float(rows[-1]["train_entropy"]) < float(rows[0]["train_entropy"])
    refuses_command(capsys, lines[0].removeprefix("scenegen ").replace("my_loss:loss", "coupled"))
    words = f"train data/pillar --weights {OWN}@runs/Net --loss my_loss:loss --maps 1"
    done(capsys, f"{words} --out runs/tuned")
    exec(example("own-network.md", "scenegen.train("), {})
    assert Path("runs/wide/best.safetensors").exists()


@pytest.mark.parametrize("network", [{"variant": "trap:Net"}, {"inputs": ["trap:rise"]}], ids=str)
def test_files_have_nothing_imported_by_themselves(here, capsys, network):
    """A stranger's network that names code in the folder where the user stands."""
    (here / "trap.py").write_text("open('sprung', 'w')")
    saved_network(here / "net.safetensors", GridSpec(shape=(24, 24, 16)))
    tensors, header = load_tensors(here / "net.safetensors")
    header["network"] |= network
    save_tensors(here / "net.safetensors", tensors, header)
    for path in ("net.safetensors", "my_net:Net@net.safetensors"):
        refuses((network, path), Completer.from_pretrained, path)
    for words in ("complete data/pillar --weights", "export", "train --weights", "inspect"):
        assert run(capsys, f"{words} net.safetensors")[0] == 1
    assert not Path("sprung").exists()


WRONG = """
import torch
from torch import nn
from scenegen.model.network import Output
from my_net import Net
class Flat(Net):
    def forward(self, batch):
        output = super().forward(batch)
        return Output(output.logits[..., 0], output.tudf[..., 0])
class Blind(Net):
    tasks = ("occupancy",)
class Negative(Net):
    def forward(self, batch):
        output = super().forward(batch)
        return Output(output.logits, -output.tudf)
class Peeking(Net):
    def forward(self, batch):
        return super().forward(batch) if "occupancy" in batch else Output(None, "shown no truth")
class Masked(Net):
    def __init__(self, config):
        super().__init__(config)
        self.register_buffer("mask", torch.ones(2, dtype=torch.bool))
class Seeing(Net):
    tasks = ("occupancy",)
    def __init__(self, config):
        super().__init__(config)
        self.again = self.body[0]
    def forward(self, batch):
        return Output(super().forward(batch).logits, None)
class Broken(Net):
    def forward(self, batch):
        raise KeyError("gone")
class Twice(Net):
    def training_step(self, batch):
        passes = [self(batch).logits for _ in range(2)]
        apart = torch.nn.functional.mse_loss(*passes)
        return {"occupied": (passes[0][batch["occupancy"]] - 3).square().mean(), "apart": apart}
class Stuck(Net):
    def training_step(self, batch): return torch.zeros(())
class Branching(Net):
    def forward(self, batch):
        logits, tudf, _ = super().forward(batch)
        return Output(logits + 1 if float(logits.sum()) > 0 else logits, tudf)
def plain(config): return 3
def detached(output, batch): return output.logits.detach().mean()
def vector(output, batch): return {"iou": output.logits.mean(), "b": 0.5}
class Scaled:
    def __init__(self, config, grid): self.scale = config.occupancy / grid.voxel_m
    def __call__(self, output, batch): return self.scale * output.logits.square().mean()
def short(seen, grid, lidar): return seen.observed[:-1]
def failing(seen, grid, lidar): raise KeyError("gone")
class Void(Net):
    def training_step(self, batch): pass
class Letters(Net): tasks = "occupancy"
"""


@each_case("../model/own_code", "asked")
def test_faults_of_own_code_are_refused(here, asked):
    config = TrainConfig.of({"variant": "my_net:Net", "width": 4} | json.loads(asked))
    data, run = [here / "data" / "pillar"], here / "run"
    refuses(asked, train, data, config, run)
    assert not run.exists()


def test_an_error_of_ones_own_network_names_its_line(here, capsys):
    words = "train data/pillar --epochs 1 --device cpu --quiet --variant wrong:Broken"
    refuses_command(capsys, words)


def test_a_network_may_have_a_training_step_of_its_own(here):
    config = TrainConfig.of({"variant": "wrong:Twice", "width": 4, "epochs": 4, "lr": 0.01})
    first, *_, last = train([here / "data" / "pillar"], config, here / "run")
    assert last["train_occupied"] < first["train_occupied"]
    assert last["train_apart"] == 0
    assert "val_occupied" not in last
    assert {"val_occupancy", "val_regression"} <= last.keys()


@pytest.mark.slow
def test_one_task_and_a_scalar_loss_will_do_and_are_exported(here, capsys):
    words = ("train", "data/pillar", "--epochs", 1, "--device", "cpu", "--quiet", "--variant")
    done(capsys, *words, "wrong:Seeing", "--loss", "wrong:Scaled", "--workers", 1)
    done(capsys, "export wrong:Seeing@runs/Seeing")
    assert Completer.from_pretrained("Seeing.onnx")(np.zeros((24, 24, 16), bool)).tudf is None
    done(capsys, *words, "wrong:Branching")
    refuses_command(capsys, "export wrong:Branching@runs/Branching")
