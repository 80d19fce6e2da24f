"""Training learns, can be interrupted anywhere, and ends in one line when it cannot go on."""

import csv
import dataclasses
import fcntl
import math
import os
import runpy
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import scenegen.model.train
from lidarsim import GridSpec
from scenegen import files
from scenegen.errors import DatasetError, StoppedError
from scenegen.model.card import SHOWN
from scenegen.model.checkpoint import CheckpointError, load_network, load_tensors, save_tensors
from scenegen.model.config import LossConfig, NetworkConfig, TrainConfig
from scenegen.model.data import Maps, TudfOf
from scenegen.model.device import TrainingError, device_name
from scenegen.model.losses import objective
from scenegen.model.network import Network
from scenegen.model.runfolder import Progress, RunFolder
from scenegen.model.train import Watcher, learning_rate, train
from tests.model.conftest import make_dataset

SMALL = TrainConfig(network=NetworkConfig(width=4), epochs=3, batch=4, precision="float32")


def test_one_batch_is_learned_by_heart(folders: list[Path]) -> None:
    """IoU above .99 at the paper's threshold, and distances within a tenth of a voxel on average."""
    maps = Maps(folders, "train")
    stacked = (torch.stack(parts) for parts in zip(maps[0], maps[12], strict=True))
    observed, occupancy = (part[:, 4:20, 4:20] for part in stacked)
    tudf = TudfOf(GridSpec(shape=(16, 16, 16)))(occupancy)
    torch.manual_seed(0)
    network = Network(NetworkConfig())
    optimizer = torch.optim.AdamW(network.parameters(), 1e-2)
    for _ in range(120):
        optimizer.zero_grad()
        output = network(observed.float())
        objective(output, occupancy, tudf, LossConfig(), voxel_m=0.2, truncation_m=2.0)["loss"].backward()
        optimizer.step()
    with torch.no_grad():
        output = network.eval()(observed.float())
    occupied = output.logits.sigmoid() >= 0.85
    assert (occupied & occupancy).sum() / (occupied | occupancy).sum() > 0.99
    assert (output.tudf - tudf).abs().mean() < 0.06


def weights(path: Path) -> dict[str, torch.Tensor]:
    return load_tensors(path)[0]


def same(one: Path, other: Path) -> bool:
    first, second = weights(one), weights(other)
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def figures(out: Path) -> list[dict[str, str]]:
    """The rows of metrics.csv, less how long they took."""
    with open(out / "metrics.csv") as file:
        return [{name: value for name, value in row.items() if name != "seconds"} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def uninterrupted(folders: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("runs") / "whole"
    train(folders, SMALL, out, device="cpu", command="test")
    return out


@pytest.fixture(autouse=True)
def undrawn(uninterrupted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the uninterrupted run draws its curve: pictures take longer than the training here."""
    monkeypatch.setattr("scenegen.model.runfolder.draw_curve", lambda rows: None)


def test_a_run_leaves_its_settings_figures_and_best_network(uninterrupted: Path, folders: list[Path]) -> None:
    with open(uninterrupted / "metrics.csv") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["epoch"]) for row in rows] == [1, 2, 3]
    assert float(rows[-1]["train_loss"]) < float(rows[0]["train_loss"])
    network, grid, about = load_network(uninterrupted / "best.safetensors")
    assert network.config == SMALL.network
    assert grid == Maps(folders, "val").grid
    assert about["figures"]["val_loss"] == pytest.approx(min(float(row["val_loss"]) for row in rows), rel=1e-5)
    assert about["settings"]["datasets"] == [str(data.manifest.digest) for data in Maps(folders, "val").datasets]
    card = (uninterrupted / "card.md").read_text()
    assert f"{about['figures']['val_iou']:.3f}" in card
    assert "This is not the full protocol" in card
    assert (uninterrupted / "curve.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("stops", [(6,), (4, 7, 12)])
def test_a_stopped_run_ends_where_an_uninterrupted_one_does(
    folders: list[Path], tmp_path: Path, uninterrupted: Path, stops: tuple[int, ...]
) -> None:
    """Bit for bit on one thread: stopped in the middle of an epoch, at its last step, and several times."""
    steps = 0

    def count(maps: int, loss: float) -> None:
        nonlocal steps
        steps += 1

    for stop in stops:
        watcher = Watcher(on_step=count, stop=lambda stop=stop: steps >= stop)
        with pytest.raises(StoppedError, match="the same command goes on"):
            train(folders, SMALL, tmp_path / "run", device="cpu", watcher=watcher)
    train(folders, SMALL, tmp_path / "run", device="cpu")
    for name in ("best.safetensors", "last.safetensors"):
        assert same(tmp_path / "run" / name, uninterrupted / name)
    assert figures(tmp_path / "run") == figures(uninterrupted)


KILLED = """
import os, signal, sys
import torch
torch.set_num_threads(1)
import scenegen.model.train
from pathlib import Path
from scenegen.model.train import Watcher, train
from tests.model.test_train import SMALL
scenegen.model.train.SAVE_EVERY_S = 0.0
scenegen.model.runfolder.draw_curve = lambda rows: None
steps = 0
def count(maps, loss):
    global steps
    steps += 1
    if steps == 9:
        os.kill(os.getpid(), signal.SIGKILL)
folders, out = [Path(name) for name in sys.argv[1:3]], Path(sys.argv[3])
train(folders, SMALL, out, device="cpu", watcher=Watcher(on_step=count))
"""


def test_a_killed_run_ends_where_an_uninterrupted_one_does(
    folders: list[Path], tmp_path: Path, uninterrupted: Path
) -> None:
    out = tmp_path / "run"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    killed = subprocess.run([sys.executable, "-c", KILLED, *map(str, folders), str(out)], env=environment, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert load_tensors(out / "last.safetensors")[1]["step"] == 2  # the third step of the second epoch was lost
    train(folders, SMALL, out, device="cpu")
    for name in ("best.safetensors", "last.safetensors"):
        assert same(out / name, uninterrupted / name)


def test_a_run_is_not_continued_by_mistake(folders: list[Path], uninterrupted: Path) -> None:
    with (uninterrupted / "config.json").open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(DatasetError, match="another process trains this run"):
            train(folders, SMALL, uninterrupted, device="cpu")
    with pytest.raises(DatasetError, match=r"lr is 0\.001 there, 0\.1 asked for"):
        train(folders, dataclasses.replace(SMALL, lr=0.1), uninterrupted, device="cpu")
    with pytest.raises(DatasetError, match="datasets is"):
        train(folders[:1], SMALL, uninterrupted, device="cpu")


def test_a_finished_run_given_again_stays_as_it_is(uninterrupted: Path, folders: list[Path]) -> None:
    before = {path.name: path.read_bytes() for path in uninterrupted.iterdir() if path.is_file()}
    told: list[int] = []
    rows = train(
        folders, SMALL, uninterrupted, device="cpu", watcher=Watcher(on_step=lambda maps, _: told.append(maps))
    )
    assert (len(rows), told) == (3, [])
    assert {path.name: path.read_bytes() for path in uninterrupted.iterdir() if path.is_file()} == before


@pytest.mark.parametrize(
    "wrong",
    [
        {"epoch": "x"},
        {"rows": 5},
        {"step": -1},
        {"rows": [[]]},
        {"rows": [{"val_loss": None}]},
        {"epoch": 9},
        {"more": 1},
    ],
    ids=str,
)
def test_a_damaged_state_is_refused_in_one_line(uninterrupted: Path, tmp_path: Path, wrong: dict) -> None:
    tensors, header = load_tensors(uninterrupted / "last.safetensors")
    save_tensors(tmp_path / "last.safetensors", tensors, header | wrong)
    network = Network(SMALL.network)
    with pytest.raises(CheckpointError, match="not the state of this run") as caught:
        RunFolder(tmp_path).restore(network, torch.optim.AdamW(network.parameters()))
    assert "\n" not in str(caught.value)


def test_a_state_that_is_no_network_says_what_to_remove(tmp_path: Path) -> None:
    (tmp_path / "last.safetensors").write_bytes(b"\xff" * 5000)
    network = Network(SMALL.network)
    with pytest.raises(CheckpointError, match="remove it to begin again"):
        RunFolder(tmp_path).restore(network, torch.optim.AdamW(network.parameters()))


@pytest.mark.parametrize("content", ["[" * 100_000, '{"settings": 1}', "\xff", "{}", " " * 5_000_000])
def test_settings_that_cannot_be_read_are_refused_in_one_line(tmp_path: Path, content: str) -> None:
    (tmp_path / "config.json").write_bytes(content.encode("latin-1"))
    with pytest.raises(DatasetError, match=r"config\.json") as caught:
        RunFolder(tmp_path).open({"settings": {}})
    assert "\n" not in str(caught.value)


def test_training_ends_after_so_many_epochs_without_improvement(
    folders: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Validation losses 3 2 2 4 1 …: the second epoch is the best of the first five with patience 3."""
    losses = iter([3.0, 2.0, 2.0, 4.0, 2.5, 1.0])
    fixed = dict.fromkeys((name.removeprefix("val_") for name in SHOWN), 0.0)
    monkeypatch.setattr(scenegen.model.train, "validate", lambda *given: {**fixed, "loss": next(losses)})
    config = dataclasses.replace(SMALL, epochs=50, patience=3)
    rows = train(folders, config, tmp_path / "run", device="cpu")
    assert [row["val_loss"] for row in rows] == [3.0, 2.0, 2.0, 4.0, 2.5]
    assert load_network(tmp_path / "run" / "best.safetensors")[2]["figures"]["epoch"] == 2


def test_divergence_names_the_batch_and_keeps_the_last_good_state(
    folders: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, steps = tmp_path / "run", 0
    honest = scenegen.model.train.objective

    def poisoned(*given: object, **named: object) -> dict[str, torch.Tensor]:
        nonlocal steps
        steps += 1
        losses = honest(*given, **named)
        return {name: loss * float("nan") for name, loss in losses.items()} if steps == 9 else losses

    monkeypatch.setattr(scenegen.model.train, "objective", poisoned)
    with pytest.raises(
        TrainingError, match=r"epoch 2, step 3: loss nan.*train sample \d+; .*train sample \d+"
    ) as caught:
        train(folders, SMALL, out, device="cpu")
    assert "\n" not in str(caught.value)
    assert load_tensors(out / "last.safetensors")[1]["epoch"] == 1
    assert all(torch.isfinite(tensor).all() for tensor in weights(out / "best.safetensors").values())


def test_running_out_of_memory_says_what_fits(
    folders: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = scenegen.model.train.objective

    def hungry(output: object, occupancy: torch.Tensor, *given: object, **named: object) -> dict[str, torch.Tensor]:
        if len(occupancy) > 3:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 7 EiB")
        return honest(output, occupancy, *given, **named)

    monkeypatch.setattr(scenegen.model.train, "objective", hungry)
    config = dataclasses.replace(SMALL, batch=12)
    with pytest.raises(TrainingError, match="a batch of 12 does not fit; --batch 3 does"):
        train(folders, config, tmp_path / "run", device="cpu")


def test_what_cannot_be_trained_on_is_refused(folders: list[Path], tmp_path: Path) -> None:
    odd = make_dataset(tmp_path / "odd", grid={"shape": (20, 24, 16)})
    with pytest.raises(DatasetError, match="multiple of 8"):
        train([odd], SMALL, tmp_path / "run", device="cpu")
    empty = make_dataset(tmp_path / "empty", counts={"train": 2, "val": 0, "test": 0})
    with pytest.raises(DatasetError, match=r"its val split is empty; generate with --val \(scenes are split by world"):
        train([empty], SMALL, tmp_path / "run", device="cpu")
    with pytest.raises(TrainingError, match="--device tpu"):
        train(folders, SMALL, tmp_path / "run", device="tpu")
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="choose another place"):
        train(folders, SMALL, tmp_path / "file" / "run", device="cpu")


def test_a_full_disk_ends_the_run_and_leaves_the_last_state(
    folders: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    train(folders, dataclasses.replace(SMALL, epochs=1), out, device="cpu")
    before = {path.name: path.read_bytes() for path in out.glob("*.safetensors")}

    def full(path: Path, mode: str) -> object:
        raise OSError(28, "No space left on device", str(path))

    network, grid = Network(SMALL.network), Maps(folders, "val").grid
    monkeypatch.setattr(files, "open", full, raising=False)
    with pytest.raises(DatasetError, match="the disk is full"):
        RunFolder(out).save(Progress(), network, torch.optim.AdamW(network.parameters()))
    with pytest.raises(DatasetError, match="the disk is full"):
        RunFolder(out).save_best(network, grid, {})
    monkeypatch.undo()
    assert before == {path.name: path.read_bytes() for path in out.glob("*.safetensors")}


def test_the_learning_rate_rises_then_falls_to_nothing() -> None:
    config = TrainConfig(lr=2.0, warmup_share=0.1)
    rates = [learning_rate(config, step, 100) for step in range(100)]
    assert rates[:10] == pytest.approx([0.2 * n for n in range(1, 11)])
    assert rates[10] == 2.0
    assert rates[55] == pytest.approx(1.0)
    assert rates[10:] == sorted(rates[10:], reverse=True)
    assert 0 < rates[-1] < 1e-3


@pytest.mark.parametrize(
    "wrong",
    [
        {"epochs": 0},
        {"batch": 0},
        {"batch": 10**9},
        {"lr": math.nan},
        {"lr": 0.0},
        {"clip": math.inf},
        {"warmup_share": 1.0},
    ],
    ids=str,
)
def test_impossible_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        TrainConfig(**wrong)


@pytest.mark.slow
def test_two_processes_train_one_network(folders: list[Path], tmp_path: Path) -> None:
    """Under torchrun: each takes half of every batch, one writes, and what comes out is whole."""
    out = tmp_path / "run"
    words = ["train", *folders, "--width", 4, "--epochs", 1, "--batch", 4, "--device", "cpu", "--quiet", "--out", out]
    words += ["--precision", "float32"]
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", 2]
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [str(word) for word in [*launch, root / "cli.py", *words]]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=100)
    assert ended.returncode == 0, ended.stderr
    assert len(figures(out)) == 1
    load_network(out / "best.safetensors")
    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=100)
    assert again.returncode == 0, again.stderr  # complete already: no process waits for the others


STEP = """
import sys
from dataclasses import replace
from pathlib import Path
import torch

import scenegen.model.train
from scenegen.model.checkpoint import save_tensors
from scenegen.model.data import Maps
from scenegen.model.device import Group
from scenegen.model.network import Network
from scenegen.model.train import Step
from tests.model.test_train import SMALL
torch.set_num_threads(1)
device = torch.device("cpu")
with Group(device) as group:
    maps = Maps([Path(name) for name in sys.argv[2:]], "train")
    torch.manual_seed(0)
    network = Network(replace(SMALL.network, variant='occ')).eval()  # or each process has statistics of its own
    optimizer = torch.optim.SGD(network.parameters(), lr=1.0)
    learn = Step(network, optimizer, SMALL, maps.grid, device, torch.float32, group)
    mine = [maps[n] for n in range(4)][group.rank :: group.size]
    losses = learn(*(torch.stack(parts) for parts in zip(*mine)), 1.0)
    save_tensors(Path(sys.argv[1] + str(group.rank)), network.state_dict(), losses)
"""


def free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return int(listening.getsockname()[1])


def test_two_processes_take_the_step_that_one_takes(
    folders: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gradients and losses are means over both; the Eikonal term is a mean of means, so distances are left out."""
    (tmp_path / "step.py").write_text(STEP)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    environment |= {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}  # as torchrun does
    command = [sys.executable, *map(str, (tmp_path / "step.py", tmp_path / "two", *folders))]
    ranks = [subprocess.Popen(command, env=environment | {"RANK": str(rank)}) for rank in range(2)]
    try:
        monkeypatch.setattr(sys, "argv", ["step.py", str(tmp_path / "one"), *map(str, folders)])
        runpy.run_path(str(tmp_path / "step.py"))
        assert [rank.wait(timeout=100) for rank in ranks] == [0, 0]
    finally:
        for rank in ranks:  # one waits long for the other
            rank.kill()
    one, losses = load_tensors(tmp_path / "one0")
    for rank in ("two0", "two1"):
        two, theirs = load_tensors(tmp_path / rank)
        assert theirs == pytest.approx(losses, rel=1e-5)
        for name, tensor in one.items():
            torch.testing.assert_close(two[name], tensor, atol=1e-6, rtol=1e-5)


def test_a_gpu_is_called_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"GPU {device.index}")
    assert device_name(torch.device("cuda", 1)) == "GPU 1"
    assert "threads" in device_name(torch.device("cpu"))
