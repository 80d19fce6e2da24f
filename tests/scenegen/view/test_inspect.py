"""What `inspect` says of a dataset is what a reader of its HDF5 files counts."""

import json
import shutil
from contextlib import ExitStack

import h5py
import numpy as np
import pytest

import scenegen
from lidarsim import GridSpec, Lidar
from scenegen.dataset.read import Dataset
from scenegen.truth.difficulty import Difficulty, difficulty
from scenegen.view.inspect import inspect, misfits
from scenegen.view.look import looks
from tests.command_line import done
from tests.conftest import dataset_in, picky_recipe

COUNTS = {"train": 11, "val": 0, "test": 4}
MIXED = """kind = "mixed"
[grid]
shape = [24, 24, 16]
[flight]
viewpoints = 2
[accept]
min_solids = 0
min_occupied_share = 0
min_returned_share = 0
[[component]]
kind = "pillar"
weight = 3
[[component]]
kind = "maze"
difficulty = "hard"
weight = 1
"""
KEYS = {"occupied", "observed", "free", "unknown", "returned", "range_m", "tudf_m"}
KEYS |= {*Difficulty._fields}
SHARES = {"occupied": "occupancy", "observed": "observed", "free": "free"}


def fields(folder, split):
    """All samples of a split, as its files hold them."""
    files = sorted(folder.glob(f"{split}-*.h5"))
    with ExitStack() as stack:
        opened = [stack.enter_context(h5py.File(file, "r")) for file in files]
        return {name: np.concatenate([file[name][:] for file in opened]) for name in opened[0]}


def check(statistics, stored, chosen):
    """Each figure of each chosen sample anew, by itself."""
    rows = []
    for n in chosen:
        ranges = stored["ranges"][n]
        row = {key: stored[name][n].mean() for key, name in SHARES.items()}
        row["unknown"] = 1 - row["observed"] - row["free"]
        row["returned"] = np.isfinite(ranges).mean()
        row["range_m"] = ranges[np.isfinite(ranges)].mean(dtype=np.float64)
        row["tudf_m"] = stored["tudf"][n].mean(dtype=np.float64)
        row |= difficulty(stored["occupancy"][n].astype(bool), stored["tudf"][n], 0.2)._asdict()
        rows.append(row)
    assert set(statistics) == KEYS
    for key, found in statistics.items():
        values = np.array([row[key] for row in rows])
        values = values[~np.isnan(values)]
        wanted = {name: getattr(values, name)() for name in ("mean", "std", "min", "max")}
        assert found == pytest.approx(wanted, rel=1e-5, abs=1e-7), key


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inspect") / "full"
    dataset_in(folder, picky_recipe(), counts=COUNTS, shard_samples=3)
    return folder


def test_counts_sizes_and_origin_are_those_of_the_folder(full):
    found = inspect(Dataset(full))
    manifest = json.loads(next(full.glob("*.json")).read_text())
    assert found["samples"] == sum(COUNTS.values())
    assert found["bytes"] == sum(len(path.read_bytes()) for path in full.iterdir())
    assert found["bytes_per_sample"] == pytest.approx(found["bytes"] / sum(COUNTS.values()))
    for name in ("seed", "complete", "digest", "fields", "rejected"):
        assert found[name] == manifest[name]


@pytest.mark.parametrize("most", [1, 4])
def test_at_most_so_many_samples_are_measured_evenly_spread(full, most):
    split = inspect(Dataset(full), most=most)["splits"]["train"]
    assert (split["sampled"], split["samples"]) == (most, COUNTS["train"])
    chosen = [n * (COUNTS["train"] - 1) // max(most - 1, 1) for n in range(most)]
    check(split["statistics"], fields(full, "train"), chosen)


def test_many_samples_are_measured_by_several_processes(full):
    few, told = inspect(Dataset(full), most=None, workers=2), []
    assert few == inspect(Dataset(full), most=None, workers=1, on_done=told.append)
    assert sum(told) == sum(COUNTS.values())
    assert len(told) > 3
    assert list(few["splits"]) == ["train", "test"]
    for name, split in few["splits"].items():
        stored = fields(full, name)
        assert split["samples"] == split["sampled"] == len(stored["world"]) == COUNTS[name]
        assert split["worlds"] == len(set(stored["world"].tolist()))
        check(split["statistics"], stored, range(COUNTS[name]))
        assert all(split["statistics"][key]["std"] > 0 for key in KEYS - set(Difficulty._fields))


def test_figures_and_samples_are_told_by_kind(tmp_path, capsys):
    (tmp_path / "r.toml").write_text(MIXED)
    options = {"n": 20, "val": 0, "test": 0, "workers": 1}
    mixed = scenegen.generate(recipe=tmp_path / "r.toml", out=tmp_path / "d", **options)
    shown, _ = looks(mixed, "train", range(20))
    assert [shown[n].name for n in (0, 19)] == ["train 0, pillar", "train 19, maze-hard"]
    for most, chosen in ((20, range(20)), (3, (0, 9, 19))):
        for kind, told in inspect(mixed, most=most)["splits"]["train"]["kinds"].items():
            own = [shown[n] for n in chosen if shown[n].name.endswith(kind)]
            known = [look.masks["observed"] | look.masks["free"] for look in own]
            assert told["sampled"] == len(own)
            found = told["statistics"]
            assert found["unknown"]["mean"] == pytest.approx(1 - np.mean(known))
            assert found["tudf_m"]["mean"] == pytest.approx(np.mean([look.tudf for look in own]))
    said = done(capsys, f"inspect {tmp_path}/d")
    assert {line.split(" ")[0] for line in said.splitlines()} >= KEYS
    full = done(capsys, f"inspect {tmp_path}/d --details")
    assert "\ntrain: means of each kind, shares in %\n" in full


def test_figures_that_are_kept_are_read_and_no_others(full, tmp_path, monkeypatch, capsys):
    """A cut table is measured anew."""
    folder = shutil.copytree(full, tmp_path / "kept")
    done(capsys, f"inspect {folder} --keep")
    every = inspect(Dataset(full), most=None)["splits"]
    (told,) = folder.glob("figures-*.json")
    assert json.loads(told.read_text()) == every
    (file,) = folder.glob("figures-*.npy")
    with monkeypatch.context() as patch:
        patch.setattr("scenegen.dataset.selection.MEASURED_AGAIN", 0)
        patch.setattr("scenegen.dataset.selection.difficulty", None)  # nothing measures
        assert inspect(Dataset(folder), most=1)["splits"] == every
    file.write_bytes(file.read_bytes()[:-1])
    assert inspect(Dataset(folder), most=1)["splits"]["train"]["sampled"] == 1


def test_a_split_without_returns_gives_valid_json(full, tmp_path, capsys):
    folder = shutil.copytree(full, tmp_path / "d")
    for file in sorted(folder.glob("test-*.h5")):
        with h5py.File(file, "r+") as opened:
            opened["ranges"][:] = np.inf
    found = inspect(Dataset(folder))
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    statistics = found["splits"]["test"]["statistics"]
    assert statistics["range_m"] == {"mean": None, "std": None, "min": None, "max": None}
    assert statistics["returned"] == {"mean": 0, "std": 0, "min": 0, "max": 0}
    assert "nan" not in done(capsys, f"inspect {folder}").lower()


def test_a_folder_of_datasets_is_listed(full, tmp_path, capsys):
    shutil.copytree(full, tmp_path / "good")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "dataset.json").write_text("{")
    (tmp_path / "else").mkdir()
    bad, good = json.loads(done(capsys, f"inspect {tmp_path} --json"))
    assert good["samples"] == COUNTS
    assert good["digest"] == inspect(Dataset(full))["digest"]
    assert "dataset.json" in bad["fault"]


def test_what_does_not_fit_is_told(rng):
    """Shares of the map against a count of random places."""
    for shape, reach in (((80, 80, 40), 10.0), ((255, 255, 64), 10.0), ((80, 80, 80), 6.0)):
        grid = GridSpec(shape=shape)
        places = rng.uniform(-0.5, 0.5, (20_000, 3)) * grid.extent_m
        beyond = (np.linalg.norm(places, axis=1) > reach).mean()
        told = misfits(grid, Lidar(max_range_m=reach))
        assert bool(told) == (beyond > 0.4)
        if told:
            assert abs(float(told[0].split()[0]) - 100 * beyond) < 4


def test_a_world_is_told(tmp_path, capsys):
    (tmp_path / "w.xml").write_text(
        "<mujoco><worldbody><geom size='1' pos='0 0 5'/><geom type='box' size='1 1 1'/>"
        "<geom type='box' size='9 9 .1'/></worldbody></mujoco>"
    )
    said = json.loads(done(capsys, f"inspect {tmp_path}/w.xml --json"))
    assert said["solids"] == {"sphere": 1, "box": 2}
