"""What `inspect` says of a dataset is what a reader of its HDF5 files counts."""

import json
import shutil

import h5py
import numpy as np
import pytest

import scenegen
from lidarsim import GridSpec, Lidar
from scenegen.dataset.read import Dataset
from scenegen.truth.difficulty import Difficulty, difficulty
from scenegen.view.inspect import inspect, misfits
from scenegen.view.look import looks
from tests.command_line import beside, done
from tests.conftest import dataset_in, picky_recipe
from tests.scenegen.verification import forge

COUNTS = {"train": 11, "val": 0, "test": 4}
MIXED = beside(__file__, "mixed.toml")
SHARES = {"occupied": "occupancy", "observed": "observed", "free": "free"}
SHOWN = {*SHARES, "unknown", "returned", "range_m", "tudf_m", *Difficulty._fields}

MOVING = {"ghosts", "movers_seen", "mover_returns"}
"""Measures that samples without movers lack."""


def fields(folder, split):
    """All samples of a split, as its files hold them."""
    shards = [forge.load(folder, file.name)[0] for file in sorted(folder.glob(f"{split}-*.h5"))]
    return {name: np.concatenate([shard[name] for shard in shards]) for name in shards[0]}


def check(statistics, stored, chosen):
    """Each figure of each chosen sample anew, by itself."""
    rows = []
    for n in chosen:
        sample = {name: values[n] for name, values in stored.items()}
        returned = np.isfinite(sample["ranges"])
        row = {key: sample[name].mean() for key, name in SHARES.items()}
        row |= {"unknown": 1 - row["observed"] - row["free"], "returned": returned.mean()}
        row["range_m"] = sample["ranges"][returned].mean(dtype=np.float64)
        row["tudf_m"] = sample["tudf"].mean(dtype=np.float64)
        row |= difficulty(sample["occupancy"].astype(bool), sample["tudf"], 0.2)._asdict()
        rows.append(row)
    assert set(statistics) == {*SHOWN, *MOVING}
    assert {value for name in MOVING for value in statistics.pop(name).values()} == {None}
    for key, figures in statistics.items():
        values = np.array([row[key] for row in rows])
        values = values[~np.isnan(values)]
        expected = {name: getattr(values, name)() for name in ("mean", "std", "min", "max")}
        assert figures == pytest.approx(expected, rel=1e-5, abs=1e-7), key


@pytest.fixture(scope="module")
def full(once):
    def make(folder):
        dataset_in(folder / "full", picky_recipe(), counts=COUNTS, shard_samples=3)

    return once("inspected", make) / "full"


def test_counts_sizes_and_origin_are_those_of_the_folder(full):
    report, manifest, samples = inspect(Dataset(full)), forge.read(full), sum(COUNTS.values())
    size = sum(path.stat().st_size for path in full.iterdir())
    assert (report["samples"], report["bytes"]) == (samples, size)
    assert report["bytes_per_sample"] == pytest.approx(size / samples)
    for name in ("seed", "complete", "digest", "fields", "rejected"):
        assert report[name] == manifest[name]


def test_many_samples_are_measured_by_several_processes(full):
    report, reported = inspect(Dataset(full), most=None, workers=2), []
    assert report == inspect(Dataset(full), most=None, workers=1, on_done=reported.append)
    assert (sum(reported), len(reported) > 3) == (sum(COUNTS.values()), True)
    assert list(report["splits"]) == ["train", "test"]
    for name, split in report["splits"].items():
        stored = fields(full, name)
        assert split["samples"] == split["sampled"] == COUNTS[name]
        assert split["worlds"] == len(set(stored["world"].tolist()))
        check(split["statistics"], stored, range(COUNTS[name]))


def test_figures_and_samples_are_reported_by_kind(tmp_path, capsys):
    (tmp_path / "r.toml").write_text(MIXED)
    options = {"n": 20, "val": 0, "test": 0, "workers": 1}
    mixed = scenegen.generate(recipe=tmp_path / "r.toml", out=tmp_path / "d", **options)
    shown, _ = looks(mixed, "train", range(20))
    assert [shown[n].name for n in (0, 19)] == ["train 0, pillar", "train 19, maze-hard"]
    for most, chosen in ((20, range(20)), (3, (0, 9, 19)), (1, (0,))):
        for kind, report in inspect(mixed, most=most)["splits"]["train"]["kinds"].items():
            means = [shown[n].tudf.mean() for n in chosen if shown[n].name.endswith(kind)]
            assert report["sampled"] == len(means)
            assert report["statistics"]["tudf_m"]["mean"] == pytest.approx(np.mean(means))
    details = done(capsys, f"inspect {tmp_path}/d --details")
    assert {line.split(" ")[0] for line in details.splitlines()} >= SHOWN
    assert "\ntrain: means of each kind, shares in %\n" in details


def test_figures_that_are_kept_are_of_all_samples_and_read(full, tmp_path, monkeypatch):
    folder = shutil.copytree(full, tmp_path / "kept")
    inspect(Dataset(folder), most=1, keep=True)
    every = inspect(Dataset(full), most=None)["splits"]
    (report,) = folder.glob("figures-*.json")
    assert json.loads(report.read_text()) == every
    monkeypatch.setattr("scenegen.dataset.selection.MEASURED_AGAIN", 0)
    monkeypatch.setattr("scenegen.dataset.selection.difficulty", None)  # nothing measures
    assert inspect(Dataset(folder), most=1)["splits"] == every


def test_a_split_without_returns_gives_valid_json(full, tmp_path, capsys):
    folder = shutil.copytree(full, tmp_path / "d")
    for path in folder.glob("test-*.h5"):
        with h5py.File(path, "r+") as shard:
            shard["ranges"][:] = np.inf
    report = json.loads(done(capsys, f"inspect {folder} --json"))["splits"]["test"]["statistics"]
    for name, value in (("range_m", None), ("returned", 0)):
        assert report[name] == dict.fromkeys(("mean", "std", "min", "max"), value)
    assert "nan" not in done(capsys, f"inspect {folder}").lower()


def test_a_folder_of_datasets_is_listed(full, tmp_path, capsys):
    (tmp_path / "good").symlink_to(full)
    for name in ("bad", "else"):
        (tmp_path / name).mkdir()
    (tmp_path / "bad" / "dataset.json").write_text("{")
    bad, good = json.loads(done(capsys, f"inspect {tmp_path} --json"))
    assert (good["samples"], good["digest"]) == (COUNTS, forge.read(full)["digest"])
    assert "dataset.json" in bad["fault"]


@pytest.mark.parametrize(
    ("shape", "reach_m"), [((80, 80, 40), 10), ((255, 255, 64), 10), ((80, 80, 80), 9)]
)
def test_a_grid_beyond_the_sensors_reach_is_reported(rng, shape, reach_m):
    """Shares of the map against a count of random places."""
    grid = GridSpec(shape=shape)
    places = rng.uniform(-0.5, 0.5, (20_000, 3)) * grid.extent_m
    beyond = 100 * (np.linalg.norm(places, axis=1) > reach_m).mean()
    notes = misfits(grid, Lidar(max_range_m=reach_m))
    assert bool(notes) == (beyond > 40)
    assert not notes or abs(float(notes[0].split()[0]) - beyond) < 4


def test_solids_of_a_world_are_counted(tmp_path, capsys):
    boxes = '<geom type="box" size="1 1 1"/>' * 2
    text = f'<mujoco><worldbody><geom size="1" pos="0 0 5"/>{boxes}</worldbody></mujoco>'
    (tmp_path / "w.xml").write_text(text)
    report = json.loads(done(capsys, f"inspect {tmp_path}/w.xml --json"))
    assert report["solids"] == {"sphere": 1, "box": 2}
