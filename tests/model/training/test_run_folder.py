"""What a run leaves on disk outlives failures, and is looked at before it is believed."""

import shutil

import pytest
import torch

from scenegen.base import files
from scenegen.model.checkpoint import load_tensors, save_tensors
from scenegen.model.network import Network
from scenegen.model.training.run_folder import Progress, RunFolder
from tests.conftest import contents
from tests.model.training.runs import SMALL, maps_of, small, train
from tests.refusals import refuses


@pytest.fixture
def begun(folders, once, undrawn):
    """A run of one epoch; not to be changed, nor to be locked."""
    return once("begun", lambda out: train(folders, small(epochs=1), out))


def restored(path):
    """A run taken up where it was, and its network."""
    folder, network = RunFolder(path), Network(SMALL.network)
    folder.restore(network, torch.optim.AdamW(network.parameters()))
    return folder, network


def test_damaged_states_are_refused(begun, tmp_path):
    tensors, header = load_tensors(begun / "last.safetensors")
    state = tmp_path / "last.safetensors"
    save_tensors(state, tensors, header | {"more": 1})
    refuses("other", restored, tmp_path)
    state.write_bytes(b"\xff" * 5000)
    refuses("bytes", restored, tmp_path)


@pytest.mark.parametrize(
    "content", ["[" * 100_000, '{"settings": 1}', "\xff", "{}", " " * 5_000_000]
)
def test_unreadable_settings_are_refused(tmp_path, content):
    (tmp_path / "config.json").write_bytes(content.encode("latin-1"))
    refuses(content[:9], RunFolder(tmp_path).open, {"settings": {}})


def test_a_full_disk_leaves_the_last_state(folders, begun, tmp_path, monkeypatch):
    out = shutil.copytree(begun, tmp_path / "run")
    before = contents(out)

    def full(path, mode):
        raise OSError(28, "No space left on device", str(path))

    (folder, network), grid = restored(out), maps_of(folders).grid
    progress = Progress(rows=[{"epoch": 1.0, "val_loss": 1.0}])
    with monkeypatch.context() as patch:
        patch.setattr(files, "open", full, raising=False)
        refuses("save", folder.save, progress)
        ended = progress, network, grid, {}, "last"
        refuses("round", folder.close_round, *ended)
    assert before == contents(out)


def test_rows_may_gain_metrics(tmp_path):
    RunFolder(tmp_path).write_rows(
        [{"epoch": 1.0, "val_loss": 2.0}, {"epoch": 2.0, "val_loss": 1.0, "val_new": 0.5}]
    )
    assert (tmp_path / "metrics.csv").read_text() == "epoch,val_loss,val_new\n1,2,\n2,1,0.5\n"
