"""What `inspect` says of scans, predictions and runs is what is in them; and they are drawn."""

import json

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose

import scenegen
from scenegen.base.errors import DatasetError
from scenegen.worlds.clouds.write import write_points
from tests.command_line import done, run
from tests.refusals import refuses, refuses_command
from tests.scenegen.view.test_page import Seen

POINTS = np.random.default_rng(0).uniform(-5, 5, (500, 3))
ROWS = """epoch,train_loss,val_loss,val_iou,val_near_mae,val_new
1,0.5,0.6,0.4,0.2,
2,0.4,0.3,0.5,0.1,
3,0.3,0.7,0.6,0.3,
"""


@pytest.fixture
def here(tmp_path):
    """A scan, predictions of a split, a completion of a scan, a run, and what is none of these."""
    write_points(tmp_path / "scan.pcd", POINTS, None, {})
    with h5py.File(tmp_path / "split.h5", "w") as file:
        file.attrs.update({"method": "mine\x1b[2J", "split": "test", "dataset": "ab12"})
        file["tudf"] = np.zeros((3, 4, 4, 2), np.float32)
    chance = np.random.default_rng(1).random((16, 16, 8)).astype(np.float32)
    with h5py.File(tmp_path / "done.h5", "w") as file:
        file.attrs.update({"method": "mine", "origin": np.zeros(3), "voxel": 0.5})
        file["observed"], file["occupancy_probability"] = chance > 0.9, chance
    for name, rows in (("run", ROWS), ("bad", "epoch,val_loss\n1,much\n"), ("none", "epoch\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.csv").write_text(rows)
    network = {"variant": "occ", "inputs": ["observed"]}
    settings = {"network": network, "kinds": ["pillar"], "samples": 7}
    (tmp_path / "run" / "config.json").write_text(json.dumps({"settings": settings}))
    with h5py.File(tmp_path / "shard.h5", "w") as file:
        file["occupancy"] = file["tudf"] = np.zeros((3, 4, 4, 2), np.float32)
    (tmp_path / "broken.h5").write_bytes(b"no")
    (tmp_path / "empty.npz").write_bytes(b"PK")
    return tmp_path


def test_a_scan_predictions_and_a_run_are_told(here, capsys):
    def told(name):
        return json.loads(done(capsys, f"inspect {here}/{name} --json"))

    found = told("scan.pcd")
    assert (found["points"], found["returns"]) == (500, 500)
    assert_allclose(found["lower_m"], POINTS.min(axis=0), atol=1e-6)
    assert_allclose(found["mean_range_m"], np.linalg.norm(POINTS, axis=1).mean(), atol=1e-6)
    found = told("split.h5")
    assert (found["of"], found["dataset"]) == ("a split", "ab12")
    assert found["arrays"] == {"tudf": [3, 4, 4, 2]}
    assert "\x1b" not in found["method"]
    found = told("run")
    assert (found["network"], found["kinds"], found["epochs"]) == ("occ", ["pillar"], 3)
    assert found["best"] == {"epoch": 2, "val_loss": 0.3, "val_iou": 0.5, "val_near_mae": 0.1}


def test_scans_completions_of_them_and_runs_are_drawn(here, capsys, monkeypatch):
    monkeypatch.setattr("scenegen.view.panels.DPI", 40)
    for name in ("scan.pcd", "done.h5", "run"):
        assert run(capsys, f"render {here}/{name} -o {here}/x.png --quiet") == (0, "", ""), name
        assert (here / "x.png").read_bytes().startswith(b"\x89PNG")
        (here / "x.png").unlink()


def test_a_path_is_shown_in_a_page_or_as_a_picture(here, capsys):
    done(capsys, f"view {here}/done.h5 -o {here}/page.html")
    samples = Seen((here / "page.html").read_text(encoding="utf-8")).data()["samples"]
    shown = scenegen.show(here / "done.h5", out=here / "shown.html")
    assert [sample["name"] for sample in samples] == [look.name for look in shown.looks] == ["done"]
    pictured = scenegen.show(str(here / "scan.pcd"), out=here / "picture.html")
    assert (pictured.looks, repr(pictured)) == ((), "<Shown: a picture>")
    assert '<img src="data:image/webp;base64,' in (here / "picture.html").read_text()
    refuses("weights", scenegen.show, here / "shard.safetensors", error=DatasetError)


def test_files_that_are_none_of_these_end_in_one_line(here, capsys):
    for name in ("broken.h5", "none.h5", "none.pcd", "none.xml", "none", "shard.h5"):
        refuses_command(capsys, f"inspect {here}/{name}")
    for name in ("split.h5", "bad", "empty.npz"):
        refuses_command(capsys, f"render {here}/{name} -o {here}/x.png")
        assert not (here / "x.png").exists()
