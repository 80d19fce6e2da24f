"""Training learns, can be interrupted anywhere, and ends in one line when it cannot go on."""

import fcntl
import multiprocessing
import os
import shutil
import signal
import time

import pytest
import torch

from scenegen.model.checkpoint import load_network, load_tensors
from scenegen.model.losses import Coupled
from scenegen.model.training import loop, run_folder
from scenegen.model.training.data import opened
from scenegen.model.training.loop import Muon, Watcher
from tests.conftest import contents
from tests.model.conftest import make_dataset
from tests.model.training.runs import (
    SMALL,
    check_same,
    elsewhere,
    figures,
    maps_of,
    small,
    train,
)
from tests.refusals import refuses


def test_muon_moves_filters_along_orthogonal_matrices():
    filters, bias = (torch.nn.Parameter(torch.zeros(shape)) for shape in ((8, 4, 3, 3, 3), (8,)))
    torch.manual_seed(0)
    for weight in (filters, bias):
        weight.grad = torch.randn_like(weight)
    Muon([filters, bias], lr=0.1).step()
    moved = torch.linalg.svdvals(filters.flatten(1)) / (0.06 * 108**0.5)
    assert ((moved > 0.6) & (moved < 1.3)).all()
    assert torch.allclose(bias, -0.1 * bias.grad.sign(), atol=1e-6)


def test_a_loader_process_that_dies_is_named(folders, monkeypatch, tmp_path):
    """Whatever the process that trains does then: here, it looks at losses."""

    before = set(multiprocessing.active_children())

    def dies(*losses):
        loader, _ = set(multiprocessing.active_children()) - before
        os.kill(loader.pid, signal.SIGKILL)
        time.sleep(10)

    monkeypatch.setattr(loop, "check_finite", dies)
    refuses("killed", train, folders, SMALL, tmp_path, workers=2)
    assert before >= {*multiprocessing.active_children()}  # or no script would end


@pytest.fixture(scope="module")
def uninterrupted(folders, once):
    """The run that none interrupts; not to be changed, nor to be locked."""
    torch.set_num_threads(1)
    return once("run", lambda out: train(folders, SMALL, out, command="test"))


@pytest.fixture(autouse=True)
def curveless(uninterrupted, undrawn):
    """Only the uninterrupted run draws its curve: pictures take longer than the training here."""


def test_runs_leave_figures_and_their_best_network(uninterrupted, folders):
    rows = figures(uninterrupted)
    assert [float(row["epoch"]) for row in rows] == [1, 2, 3]
    assert float(rows[-1]["train_loss"]) < float(rows[0]["train_loss"])
    network, grid, about = load_network(uninterrupted / "best.safetensors")
    assert network.config == SMALL.network
    assert grid == maps_of(folders).grid
    assert about["figures"]["val_loss"] == pytest.approx(
        min(float(row["val_loss"]) for row in rows), rel=1e-5
    )
    assert about["settings"]["datasets"] == [source.digest for source in opened(folders, "val")]
    assert f"{about['figures']['val_iou']:.3f}" in (uninterrupted / "card.md").read_text()
    assert (uninterrupted / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_stopped_runs_end_as_uninterrupted_ones(folders, tmp_path, uninterrupted):
    """Bit for bit on one thread, stopped three times: in the middle of an epoch, at its last step
    and at its first."""
    losses = []
    for stop in (4, 6, 7):
        watcher = Watcher(
            on_step=lambda maps, loss: losses.append(loss),
            stop=lambda stop=stop: len(losses) >= stop,
        )
        refuses(stop, train, folders, SMALL, tmp_path / "run", watcher=watcher)
    train(folders, SMALL, tmp_path / "run")
    check_same(tmp_path / "run", uninterrupted)


def test_a_run_keeps_its_settings(folders, tmp_path, uninterrupted):
    """Its precision, whatever the device; and earlier versions named a stem stride."""
    out = shutil.copytree(uninterrupted, tmp_path / "run")
    config, automatic = out / "config.json", small(precision="auto")
    old = config.read_text().replace('"float32"', '"bfloat16"')
    config.write_text(old.replace('"heads": 4', '"stem_stride": 2, "heads": 4'))
    train(folders, automatic, out)
    adamw = small(precision="auto", optimizer="adamw")
    refuses("optimizer", train, folders, adamw, out)
    config.write_text(old.replace('"heads": 4', '"stem_stride": 1, "heads": 4'))
    refuses("stride", train, folders, automatic, out)


def train_and_be_killed(folders, out):
    """SIGKILL after the ninth step, with every step saved."""
    torch.set_num_threads(1)
    run_folder.SAVE_EVERY_S = 0.0
    losses = []

    def count(maps, loss):
        losses.append(loss)
        if len(losses) == 9:
            os.kill(os.getpid(), signal.SIGKILL)

    train(folders, SMALL, out, watcher=Watcher(on_step=count))


def test_killed_runs_end_as_uninterrupted_ones(folders, tmp_path, uninterrupted):
    out = tmp_path / "run"
    process = elsewhere(train_and_be_killed, folders, out)
    process.join()
    assert process.exitcode == -signal.SIGKILL
    # the third step of the second epoch was lost
    assert load_tensors(out / "last.safetensors")[1]["step"] == 2
    train(folders, SMALL, out)
    check_same(out, uninterrupted)


def test_finished_runs_are_not_continued_by_mistake(folders, tmp_path, uninterrupted):
    out = shutil.copytree(uninterrupted, tmp_path / "run")
    held = os.open(out, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    # nor by a larger budget
    refuses("another process", train, folders, small(epochs=9), out)
    os.close(held)
    refuses("lr", train, folders, small(lr=0.1), out)
    refuses("datasets", train, folders[:1], SMALL, out)
    before = contents(out)
    assert len(train(folders, SMALL, out)) == 3
    assert contents(out) == before


def wrap_losses(monkeypatch, change):
    """Have losses changed by `change`, which is given them and the batch."""
    honest = Coupled.__call__

    def losses(objective, output, batch):
        return change(honest(objective, output, batch), batch)

    monkeypatch.setattr(Coupled, "__call__", losses)


def test_divergence_keeps_the_last_good_state(folders, tmp_path, monkeypatch):
    """And names the batch."""
    steps = []

    def poison(losses, batch):
        steps.extend([1] * torch.is_grad_enabled())  # of training
        return {
            name: loss * float("nan" if len(steps) == 9 else 1) for name, loss in losses.items()
        }

    wrap_losses(monkeypatch, poison)
    refuses("nan", train, folders, SMALL, tmp_path)
    assert len(load_tensors(tmp_path / "last.safetensors")[1]["rows"]) == 1
    load_tensors(tmp_path / "best.safetensors")  # finite, or it is refused


def test_batches_that_do_not_fit_are_refused(folders, tmp_path, monkeypatch):
    def run_out(losses, batch):
        if len(batch["occupancy"]) > 3:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 7 EiB")
        return losses

    wrap_losses(monkeypatch, run_out)
    refuses(12, train, folders, small(batch=12), tmp_path)


def test_unfit_datasets_and_places_are_refused(folders, tmp_path):
    (tmp_path / "file").write_text("")
    odd = make_dataset(tmp_path / "odd", grid={"shape": (20, 24, 16)})
    empty = make_dataset(tmp_path / "empty", counts={"train": 2, "val": 0, "test": 0})
    refuses("odd", train, [odd], SMALL, tmp_path / "run")
    refuses("empty", train, [empty], SMALL, tmp_path / "run")
    refuses("device", train, folders, SMALL, tmp_path / "run", device="tpu")
    refuses("file", train, folders, SMALL, tmp_path / "file/run")
