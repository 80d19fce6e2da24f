"""`scenegen train`, `complete`, `export`, `networks` and `bench --weights` as users meet them."""

import csv
import json

import h5py
import numpy as np
import pytest

from lidarsim.grid import iou
from scenegen.dataset.read import Dataset
from scenegen.model.checkpoint import load_network, save_network
from scenegen.model.completion.completer import Completer
from scenegen.model.config import LossConfig
from scenegen.worlds.clouds.write import write_points
from tests.command_line import done, refused, rows, run
from tests.model.commands.test_bench import here
from tests.refusals import refuses_command

assert here  # the fixture
QUICK = ("--width", 4, "--batch", 2, "--device", "cpu", "--precision", "float32")


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
    assert "what another command began" in refused(
        capsys, "complete data/pillar --weights runs/tuned --quiet"
    )
    with h5py.File("predictions/test-00000.h5") as file:
        assert set(file) == {"occupancy_probability", "tudf", "world", "viewpoint", "sha256"}
    named = "bench", "--weights", "my net=runs/proposed", "--weights", "runs/proposed"
    words = "--method returns --predictions predictions --quick --workers 1"
    done(capsys, *named, *words.split())
    report = json.loads((here / "bench" / "report.json").read_text())["reconstruction"]["pillar"]
    assert list(report) == ["returns", "my net", "proposed", "predictions"]
    assert report["my net"] == report["proposed"]
    assert report["proposed"]["near_mae"]["mean"] == pytest.approx(
        report["predictions"]["near_mae"]["mean"], abs=1e-4
    )
    scans = [here / "drive" / "velodyne" / f"{n:06d}.bin" for n in range(2)]
    for scan in scans:
        write_points(scan, np.random.default_rng(0).uniform(-1, 1, (50, 3)), None, {})
    words = "complete drive --weights runs/proposed --device cpu"
    done(capsys, words)
    made = sorted((here / "drive.completed").rglob("*.h5"))
    assert [path.relative_to(here / "drive.completed") for path in made] == [
        scan.relative_to(here / "drive").with_suffix(".h5") for scan in scans
    ]
    made[0].unlink()
    kept = made[1].stat().st_mtime_ns
    (here / "drive" / "broken.pcd").write_bytes(b"")
    code, _, said = run(capsys, f"{words} --quiet")  # goes on
    assert (code, said.count("\n")) == (1, 2)
    assert "broken.pcd" in said
    assert made[0].exists()
    assert made[1].stat().st_mtime_ns == kept
    assert "what another command began" in refused(capsys, f"{words} --sensor 0 0 1")


def check_best_iou(said, here):
    """What `train` says of IoU at both thresholds is what its network reaches on validation."""
    *_, last = csv.DictReader((here / "runs" / "proposed" / "metrics.csv").open())
    split = Dataset(here / "data" / "pillar").split("val")
    complete = Completer.from_pretrained(here / "runs" / "proposed")
    maps = [(complete(sample).occupancy_probability, sample.occupancy) for sample in split]
    ious = {
        at: np.mean([iou(said > np.float32(at), truth) for said, truth in maps])
        for at in np.arange(5, 100, 5) / 100
    }
    best = max(ious, key=ious.get)
    assert float(last["val_best_iou"]) == pytest.approx(ious[best], abs=1e-5)
    assert float(last["val_best_probability"]) == pytest.approx(best)
    paper = f"IoU {ious[0.85]:.3f} at the paper's threshold 0.85"
    assert f"{paper}, {ious[best]:.3f} at the best, {best:g}" in said


def test_a_stream_trains_without_a_dataset(here, small, capsys):
    mixed = f"--stream {small}=2 --stream geometric.toml --stream-seed 3 --interval 8"
    words = (*mixed.split(), *QUICK)
    (here / "geometric.toml").write_text(small.read_text().replace("pillar", "geometric"))
    assert done(capsys, "train", *words, "--maps", 16, "--val-maps", 6).count("epoch ") == 3
    assert settings_of(here / "runs" / "proposed")["kinds"] == ["pillar+geometric"]


BAD_USE = """
train --variant propose
train --lr -1
train --stream pillar
train --stream pillar=much --maps 8
train data/pillar --stream pillar --maps 8 --val-maps 8
train data/pillar=2 --stream pillar --maps 8
train data/pillar --stream pillar --maps 8
complete pickle.pt -o new.pt
complete data/pillar -o /dev/null
complete data/pillar --weights pickle.pt
bench --method returns --method returns
bench --weights a=columns --weights a=occ
bench --weights a=column
bench data/pillar --method extrud
bench data/pillar data/pillar
"""


def test_bad_use_ends_in_one_line(here, capsys):
    (here / "pickle.pt").write_bytes(b"\x80\x04nothing")
    for (words,) in rows(BAD_USE):
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
