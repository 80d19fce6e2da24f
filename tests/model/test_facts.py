"""What `inspect` says of scans, predictions and runs is what is in them; and they are drawn."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

import scenegen
from scenegen.model.completion.scans import looks_of_completion
from scenegen.worlds.clouds.write import write_points
from tests.command_line import done, run
from tests.refusals import refuses, refuses_command
from tests.scenegen import cases
from tests.scenegen.view.test_page import Seen

POINTS = np.random.default_rng(0).uniform(-5, 5, (500, 3))
ROWS = """epoch,train_loss,val_loss,val_iou,val_near_mae,val_new
1,0.5,0.6,0.4,0.2,
2,0.4,0.3,0.5,0.1,
3,0.3,0.7,0.6,0.3,
"""


def write(path, attributes, **arrays):
    """An HDF5 file."""
    with h5py.File(path, "w") as file:
        file.attrs.update(attributes)
        file.update(arrays)


@pytest.fixture
def here(standing):
    """A scan, predictions of a split, a completion of a scan, a run, and what is none of these."""
    write_points(standing / "scan.pcd", POINTS, None, {})
    maps, chance = np.zeros((3, 4, 4, 2), np.float32), np.random.default_rng(1).random((16, 16, 8))
    about = {"method": "mine\x1b[2J", "split": "test", "dataset": "ab12"}
    write("split.h5", about, tudf=maps)
    write("shard.h5", {}, tudf=maps, occupancy=maps)
    about = {"method": "mine", "origin": np.zeros(3), "voxel": 0.5}
    write("done.h5", about, observed=chance > 0.9, occupancy_probability=np.float32(chance))
    for name, rows in (("run", ROWS), ("bad", "epoch,val_loss\n1,much\n"), ("none", "epoch\n")):
        Path(name).mkdir()
        Path(name, "metrics.csv").write_text(rows)
    settings = {"network": {"variant": "occ", "inputs": ["observed"]}, "kinds": ["pillar"]}
    Path("run/config.json").write_text(json.dumps({"settings": settings | {"samples": 7}}))
    Path("broken.h5").write_bytes(b"no")
    Path("empty.npz").write_bytes(b"PK")
    return standing


EXPECTED = {name: json.loads(facts) for name, facts in cases("../model/facts")}
EXPECTED["scan.pcd"] = {
    "points": 500,
    "returns": 500,
    "lower_m": pytest.approx(POINTS.min(axis=0), abs=1e-6),
    "mean_range_m": pytest.approx(np.linalg.norm(POINTS, axis=1).mean(), abs=1e-6),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_files_are_inspected(here, capsys, name):
    facts = json.loads(done(capsys, f"inspect {name} --json"))
    assert {key: facts[key] for key in EXPECTED[name]} == EXPECTED[name]


@pytest.mark.parametrize("name", ["scan.pcd", "done.h5", "run"])
def test_files_are_drawn(here, capsys, monkeypatch, name):
    monkeypatch.setattr("scenegen.view.stills.DPI", 40)
    assert run(capsys, f"render {name} -o x.png --quiet") == (0, "", "")
    assert Path("x.png").read_bytes().startswith(b"\x89PNG")


def test_a_path_is_shown_in_a_page_or_as_a_picture(here, capsys):
    done(capsys, "view done.h5 -o page.html")
    (sample,) = Seen(Path("page.html").read_text(encoding="utf-8")).data()["samples"]
    (look,) = scenegen.show(here / "done.h5", out=here / "shown.html").looks
    assert sample["name"] == look.name == "done"
    picture = scenegen.show("run", out="picture.html")
    assert (picture.looks, repr(picture)) == ((), "<Shown: a picture>")
    assert '<img src="data:image/png;base64,' in Path("picture.html").read_text()
    refuses("weights", scenegen.show, here / "shard.safetensors")


def test_completions_of_a_folder_are_shown(here):
    many = here / "many"
    many.mkdir()
    (many / "completions.json").write_text("{}")
    for name in ("a.h5", "b.h5"):
        shutil.copy("done.h5", many / name)
    assert [look.name for look in looks_of_completion(many)] == ["a", "b"]
    (many / "predictions.json").write_text("{}")
    refuses("predictions", looks_of_completion, many)


def test_a_changed_completion_is_refused(here):
    with h5py.File("done.h5", "a") as file:
        file.attrs["digest"] = "00"
    refuses("changed", looks_of_completion, here / "done.h5")


def test_other_files_are_refused(here, capsys):
    for name in ("broken.h5", "none.h5", "none.pcd", "none.xml", "none", "shard.h5"):
        refuses_command(capsys, f"inspect {name}")
    for name in ("split.h5", "bad", "empty.npz"):
        refuses_command(capsys, f"render {name} -o x.png")
    assert not Path("x.png").exists()
