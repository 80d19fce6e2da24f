"""What a run leaves on disk outlives failures, and is looked at before it is believed."""

import dataclasses
import shutil

import pytest
import torch

from scenegen.base import files
from scenegen.base.errors import DatasetError
from scenegen.model.checkpoint import CheckpointError, load_tensors, save_tensors
from scenegen.model.network import Network
from scenegen.model.training.run_folder import Progress, RunFolder
from tests.conftest import contents
from tests.model.training.runs import SMALL, maps_of, train


@pytest.fixture(scope="module")
def begun(folders, once):
    """A run of one epoch; not to be changed, nor to be locked."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, "draw_rows", lambda folder, rows: None)
        return once(
            "begun",
            lambda out: train(folders, dataclasses.replace(SMALL, epochs=1), out),
        )


def test_a_damaged_state_is_refused_in_one_line(begun, tmp_path):
    tensors, header = load_tensors(begun / "last.safetensors")
    state = tmp_path / "last.safetensors"
    network = Network(SMALL.network)
    for damage, told in (
        (lambda: save_tensors(state, tensors, header | {"more": 1}), "not the state of this run"),
        (lambda: state.write_bytes(b"\xff" * 5000), "remove it to begin again"),
    ):
        damage()
        with pytest.raises(CheckpointError, match=told):
            RunFolder(tmp_path).restore(network, torch.optim.AdamW(network.parameters()))


@pytest.mark.parametrize(
    "content", ["[" * 100_000, '{"settings": 1}', "\xff", "{}", " " * 5_000_000]
)
def test_settings_that_cannot_be_read_are_refused_in_one_line(tmp_path, content):
    (tmp_path / "config.json").write_bytes(content.encode("latin-1"))
    with pytest.raises(DatasetError, match=r"config\.json"):
        RunFolder(tmp_path).open({"settings": {}})


def test_a_full_disk_ends_the_run_and_leaves_the_last_state(folders, begun, tmp_path, monkeypatch):
    out = shutil.copytree(begun, tmp_path / "run")
    before = contents(out)

    def full(path, mode):
        raise OSError(28, "No space left on device", str(path))

    network, grid = Network(SMALL.network), maps_of(folders).grid
    folder = RunFolder(out)
    folder.restore(network, torch.optim.AdamW(network.parameters()))
    progress = Progress(rows=[{"epoch": 1.0, "val_loss": 1.0}])
    with monkeypatch.context() as patch:
        patch.setattr(files, "open", full, raising=False)
        for write, more in ((folder.save, ()), (folder.close_round, (network, grid, {}, "last"))):
            with pytest.raises(DatasetError, match="the disk is full"):
                write(progress, *more)
    assert before == contents(out)


def test_rows_may_gain_metrics_on_the_way(tmp_path):
    RunFolder(tmp_path).write_rows(
        [{"epoch": 1.0, "val_loss": 2.0}, {"epoch": 2.0, "val_loss": 1.0, "val_new": 0.5}]
    )
    assert (tmp_path / "metrics.csv").read_text() == "epoch,val_loss,val_new\n1,2,\n2,1,0.5\n"
