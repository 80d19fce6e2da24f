"""`scenegen train`, `complete`, `export`, `networks` and `bench --weights` as users meet them."""

import csv
import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from lidarsim.grid import iou
from scenegen import Completer, Dataset
from scenegen.model.checkpoint import load_network, save_network
from scenegen.model.config import LossConfig
from scenegen.worlds.clouds.write import write_points
from tests.command_line import done, run
from tests.conftest import dataset_in
from tests.model.conftest import saved_network
from tests.refusals import refuses_command
from tests.scenegen import cases

QUICK = ("--width", 4, "--batch", 2, "--device", "cpu", "--precision", "float32")


@pytest.fixture
def here(once, tmp_path, monkeypatch, undrawn):
    """A folder with a small dataset under data/, to stand in."""

    def generate(folder):
        dataset_in(folder / "data" / "pillar", counts={"train": 6, "val": 3, "test": 3})

    monkeypatch.chdir(tmp_path)
    shutil.copytree(once("here", generate), tmp_path, dirs_exist_ok=True)
    return tmp_path


def settings_of(run):
    """What a run was begun with."""
    return json.loads((run / "config.json").read_text())["settings"]


def test_train_complete_and_bench_work_together(here, capsys):
    said = done(capsys, "train", "--epochs", 2, "--lambda-occupancy", 0.7, *QUICK)
    assert "best: epoch" in said
    check_best_iou(said, here)
    assert settings_of(here / "runs" / "proposed")["network"]["width"] == 4
    best = here / "runs" / "proposed" / "best.safetensors"
    network, grid, about = load_network(best)
    about["settings"]["loss"] |= {"near_m": 0.9, "jaccard": 1.0}  # which no option says
    save_network(best, network, grid, about)
    words = "train --weights runs/proposed --maps 1 --beta 2 --out runs/tuned"
    done(capsys, *words.split(), *QUICK[2:])
    tuned = LossConfig(**settings_of(here / "runs" / "tuned")["loss"])
    # the network's own, but for what is given
    assert tuned == LossConfig(occupancy=0.7, beta_m=2, near_m=0.9)
    said = done(capsys, "complete data/pillar --weights runs/proposed --device cpu")
    assert said == "written: predictions\n"
    refuses_command(capsys, "complete data/pillar --weights runs/tuned --quiet")
    with h5py.File("predictions/test-00000.h5") as file:
        assert set(file) == {"occupancy_probability", "tudf", "world", "viewpoint", "sha256"}
    words = (
        "bench --weights mine=runs/proposed --weights runs/proposed --method returns "
        "--predictions predictions --quick --workers 1"
    )
    assert "pillar, planning" in done(capsys, words)
    report = json.loads(Path("bench/report.json").read_text())
    assert report["command"] == f"scenegen {words}"
    rows = report["reconstruction"]["pillar"]
    assert list(rows) == ["returns", "mine", "proposed", "predictions"]
    assert rows["mine"] == rows["proposed"]
    errors = [rows[name]["near_mae"]["mean"] for name in ("proposed", "predictions")]
    assert errors[0] == pytest.approx(errors[1], abs=1e-4)


def test_a_folder_of_scans_is_completed(here, capsys):
    """A run goes on where it was, past files that are none."""
    saved_network(here / "n.safetensors", Dataset(here / "data" / "pillar").grid)
    for n in range(2):
        points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
        write_points(here / "drive" / "velodyne" / f"{n:06d}.bin", points, None, {})
    words = "complete drive --weights n.safetensors --device cpu"
    done(capsys, words)
    first, second = made = sorted(Path("drive.completed/velodyne").glob("*.h5"))
    assert [path.name for path in made] == ["000000.h5", "000001.h5"]
    first.unlink()
    written = second.stat().st_mtime_ns
    Path("drive/broken.pcd").write_bytes(b"")
    code, _, said = run(capsys, f"{words} --quiet")
    assert (code, said.count("\n"), "broken.pcd" in said) == (1, 2, True)
    assert first.exists()
    assert second.stat().st_mtime_ns == written
    refuses_command(capsys, f"{words} --sensor 0 0 1")


def check_best_iou(said, here):
    """What `train` says of IoU at both thresholds is what its network reaches on validation."""
    *_, last = csv.DictReader((here / "runs" / "proposed" / "metrics.csv").open())
    complete = Completer.from_pretrained(here / "runs" / "proposed")
    split = Dataset(here / "data" / "pillar").split("val")
    maps = [(complete(sample).occupancy_probability, sample.occupancy) for sample in split]
    usual, best = (
        np.mean([iou(chance > np.float32(at), truth) for chance, truth in maps])
        for at in (0.85, float(last["val_best_probability"]))
    )
    assert float(last["val_best_iou"]) == pytest.approx(best, abs=1e-5)
    assert f"IoU {usual:.3f} at the paper's threshold 0.85, {best:.3f} at the best, " in said


def test_a_stream_trains_without_a_dataset(here, small, capsys):
    mixed = f"--stream {small}=2 --stream geometric.toml --stream-seed 3 --interval 8"
    words = (*mixed.split(), *QUICK)
    (here / "geometric.toml").write_text(small.read_text().replace("pillar", "geometric"))
    assert done(capsys, "train", *words, "--maps", 16, "--val-maps", 6).count("epoch ") == 3
    assert settings_of(here / "runs" / "proposed")["kinds"] == ["pillar+geometric"]


def test_bad_use_ends_in_one_line(here, capsys):
    (here / "pickle.pt").write_bytes(b"\x80\x04nothing")
    for (words,) in cases("../model/bad_use"):
        refuses_command(capsys, words)
    (here / "data").rename("elsewhere")
    refuses_command(capsys, "bench")


WITHOUT = (
    "import sys; sys.modules |= dict.fromkeys(('torch', 'rosbags', 'gymnasium'));"
    "from scenegen.__main__ import main; main()"
)


@pytest.mark.checkout
def test_without_an_extra_it_says_what_to_install(tmp_path, shell, made):
    (tmp_path / "without.py").write_text(WITHOUT)
    (tmp_path / "my_command.py").write_text("import scenegen\nscenegen.Flight")
    (tmp_path / "drive.mcap").touch()
    for extra, *words in (
        ("train", "train", "anything"),
        ("train", "bench", made, "--weights", "proposed"),
        ("mcap", "ingest", "drive.mcap"),
        ("fly", "my_command:fly"),
    ):
        ended = shell.python("without.py", *words, here=tmp_path)
        assert not ended.out
        assert "Traceback" not in ended.err
        assert f"pip install -e '.[{extra}]'" in ended.err
