"""Training learns, can be interrupted anywhere, and ends in one line when it cannot go on."""

import dataclasses
import fcntl
import multiprocessing
import os
import shutil
import signal
import time

import numpy as np
import pytest
import torch

import scenegen.model.training.loop
from lidarsim import GridSpec
from scenegen.base.errors import DatasetError, StoppedError
from scenegen.model.bench.metrics import METRICS
from scenegen.model.checkpoint import load_network, load_tensors
from scenegen.model.config import LossConfig, NetworkConfig
from scenegen.model.losses import Coupled
from scenegen.model.network import Network
from scenegen.model.training.data import LoaderError, opened
from scenegen.model.training.device import TrainingError
from scenegen.model.training.loop import Muon, Watcher
from scenegen.truth import distance_field
from tests.conftest import contents
from tests.model.conftest import make_dataset
from tests.model.training.runs import SMALL, check_same, elsewhere, figures, maps_of, train


def test_one_batch_is_learned_by_heart(folders):
    """IoU above .99 at the paper's threshold, and distances within a tenth of a voxel on
    average."""
    maps = maps_of(folders)
    batch = {name: torch.stack([maps[0][name], maps[12][name]])[:, 8:16, 8:16] for name in maps[0]}
    occupancy = batch["occupancy"]
    grid = GridSpec(shape=(8, 8, 16))
    fields = [distance_field(one, grid) for one in occupancy.numpy()]
    batch["tudf"] = tudf = torch.from_numpy(np.stack(fields))
    torch.manual_seed(0)
    network = Network(NetworkConfig())
    optimizer = torch.optim.AdamW(network.parameters(), 1e-2)
    for step in range(240):
        optimizer.zero_grad()
        output = network.train()(batch)
        Coupled(LossConfig(), grid)(output, batch)["loss"].backward()
        optimizer.step()
        if step % 20 == 19:
            with torch.no_grad():
                output = network.eval()(batch)
            occupied = output.logits.sigmoid() >= 0.85
            iou = (occupied & occupancy).sum() / (occupied | occupancy).sum()
            error_m = (output.tudf - tudf).abs().mean()
            if iou > 0.99 and error_m < 0.06:
                return
    pytest.fail(f"after {step + 1} steps IoU {iou:.3f}, {error_m:.3f} m")


def test_muon_moves_filters_along_an_orthogonal_matrix_and_biases_as_adamw_does():
    filters, bias = (torch.nn.Parameter(torch.zeros(shape)) for shape in ((8, 4, 3, 3, 3), (8,)))
    torch.manual_seed(0)
    for one in (filters, bias):
        one.grad = torch.randn_like(one)
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

    monkeypatch.setattr("scenegen.model.training.loop.check_finite", dies)
    with pytest.raises(LoaderError, match="--workers 0") as kept:
        train(folders, SMALL, tmp_path, workers=2)
    assert before >= {*multiprocessing.active_children()}, kept  # or no script would end


@pytest.fixture(scope="module")
def uninterrupted(folders, once):
    """The run that none interrupts; not to be changed, nor to be locked."""
    torch.set_num_threads(1)
    return once("run", lambda out: train(folders, SMALL, out, command="test"))


@pytest.fixture(autouse=True)
def curveless(uninterrupted, undrawn):
    """Only the uninterrupted run draws its curve: pictures take longer than the training here."""


def test_a_run_leaves_its_settings_figures_and_best_network(uninterrupted, folders):
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


def test_a_stopped_run_ends_where_an_uninterrupted_one_does(folders, tmp_path, uninterrupted):
    """Bit for bit on one thread, stopped three times: in the middle of an epoch, at its last step
    and at its first."""
    steps = 0

    def count(maps, loss):
        nonlocal steps
        steps += 1

    for stop in (4, 6, 7):
        watcher = Watcher(on_step=count, stop=lambda stop=stop: steps >= stop)
        with pytest.raises(StoppedError, match="the same command goes on"):
            train(folders, SMALL, tmp_path / "run", watcher=watcher)
    train(folders, SMALL, tmp_path / "run")
    check_same(tmp_path / "run", uninterrupted)


def test_a_run_keeps_what_it_was_begun_with_where_nothing_else_is_asked_for(
    folders, tmp_path, uninterrupted
):
    """Its precision, whatever the device; and earlier versions named a stem stride."""
    shutil.copytree(uninterrupted, tmp_path / "run")
    config = tmp_path / "run" / "config.json"
    old = config.read_text().replace('"float32"', '"bfloat16"')
    config.write_text(old.replace('"heads": 4', '"stem_stride": 2, "heads": 4'))
    asked = dataclasses.replace(SMALL, precision="auto")
    train(folders, asked, tmp_path / "run")
    with pytest.raises(DatasetError, match="optimizer is "):
        train(folders, dataclasses.replace(asked, optimizer="adamw"), tmp_path / "run")
    config.write_text(old.replace('"heads": 4', '"stem_stride": 1, "heads": 4'))
    with pytest.raises(DatasetError, match="stem_stride = 1: networks have 2"):
        train(folders, asked, tmp_path / "run")


def train_and_be_killed(folders, out):
    """SIGKILL after the ninth step, with every step saved."""
    torch.set_num_threads(1)
    scenegen.model.training.run_folder.SAVE_EVERY_S = 0.0
    losses = []

    def count(maps, loss):
        losses.append(loss)
        if len(losses) == 9:
            os.kill(os.getpid(), signal.SIGKILL)

    train(folders, SMALL, out, watcher=Watcher(on_step=count))


def test_a_killed_run_ends_where_an_uninterrupted_one_does(folders, tmp_path, uninterrupted):
    out = tmp_path / "run"
    process = elsewhere(train_and_be_killed, folders, out)
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert (
        load_tensors(out / "last.safetensors")[1]["step"] == 2
    )  # the third step of the second epoch was lost
    train(folders, SMALL, out)
    check_same(out, uninterrupted)


def test_a_run_is_not_continued_by_mistake_nor_once_it_is_finished(
    folders, tmp_path, uninterrupted
):
    out = shutil.copytree(uninterrupted, tmp_path / "run")
    held = os.open(out, os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with pytest.raises(DatasetError, match="another process trains this run"):
        train(folders, dataclasses.replace(SMALL, epochs=9), out)  # nor by a larger budget
    os.close(held)
    with pytest.raises(DatasetError, match=r"lr is 0\.001 there, 0\.1 asked for"):
        train(folders, dataclasses.replace(SMALL, lr=0.1), out)
    with pytest.raises(DatasetError, match="datasets is"):
        train(folders[:1], SMALL, out)
    before = contents(out)
    assert len(train(folders, SMALL, out)) == 3
    assert contents(out) == before


def test_training_ends_after_so_many_epochs_without_improvement(folders, tmp_path, monkeypatch):
    """Validation losses 3 2 2 4 1 …: the second epoch is the best of the first five with patience
    3."""
    losses = iter([3.0, 2.0, 2.0, 4.0, 2.5, 1.0])
    fixed = dict.fromkeys(METRICS, 0.0)
    monkeypatch.setattr(
        scenegen.model.training.loop, "validate", lambda *given: {**fixed, "loss": next(losses)}
    )
    config = dataclasses.replace(SMALL, epochs=50, patience=3, schedule="constant")
    rows = train(folders[:1], config, tmp_path / "run")
    assert [row["val_loss"] for row in rows] == [3.0, 2.0, 2.0, 4.0, 2.5]
    assert load_network(tmp_path / "run" / "best.safetensors")[2]["figures"]["epoch"] == 2


def test_divergence_names_the_batch_and_keeps_the_last_good_state(folders, tmp_path, monkeypatch):
    out, steps = tmp_path / "run", 0
    honest = Coupled.__call__

    def poisoned(*given):
        nonlocal steps
        steps += torch.is_grad_enabled()  # of training
        losses = honest(*given)
        return (
            {name: loss * float("nan") for name, loss in losses.items()} if steps == 9 else losses
        )

    monkeypatch.setattr(Coupled, "__call__", poisoned)
    said = r"epoch 2, step 3: loss nan.*train sample \d+; .*train sample \d+"
    with pytest.raises(TrainingError, match=said):
        train(folders, SMALL, out)
    assert len(load_tensors(out / "last.safetensors")[1]["rows"]) == 1
    load_tensors(out / "best.safetensors")  # finite, or it is refused


def test_running_out_of_memory_ends_in_a_line(folders, tmp_path, monkeypatch):
    honest = Coupled.__call__

    def hungry(loss, output, batch):
        if len(batch["occupancy"]) > 3:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 7 EiB")
        return honest(loss, output, batch)

    monkeypatch.setattr(Coupled, "__call__", hungry)
    config = dataclasses.replace(SMALL, batch=12)
    with pytest.raises(TrainingError, match="a batch of 12 does not fit; give a smaller --batch"):
        train(folders, config, tmp_path / "run")


def test_what_cannot_be_trained_on_is_refused(folders, tmp_path):
    odd = make_dataset(tmp_path / "odd", grid={"shape": (20, 24, 16)})
    with pytest.raises(DatasetError, match="multiple of 8"):
        train([odd], SMALL, tmp_path / "run")
    empty = make_dataset(tmp_path / "empty", counts={"train": 2, "val": 0, "test": 0})
    with pytest.raises(
        DatasetError,
        match=r"its val split is empty; generate with --val \(scenes are split by world",
    ):
        train([empty], SMALL, tmp_path / "run")
    with pytest.raises(TrainingError, match="--device tpu"):
        train(folders, SMALL, tmp_path / "run", device="tpu")
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="choose another place"):
        train(folders, SMALL, tmp_path / "file" / "run")
