"""What `inspect` says of a dataset is what a reader of its HDF5 files counts."""

import json
import shutil

import h5py
import numpy as np
import pytest

import scenegen
from lidarsim import GridSpec, Lidar
from scenegen.dataset.build import build
from scenegen.dataset.read import Dataset
from scenegen.display.inspect import inspect, misfits
from scenegen.display.look import looks
from scenegen.truth.difficulty import Difficulty, difficulty
from tests.command_line import run
from tests.conftest import picky_recipe, plan_of
from tests.scenegen.dataset.test_mixed import RECIPE

COUNTS = {"train": 11, "val": 0, "test": 4}
KEYS = {"occupied", "observed", "free", "unknown", "returned", "range_m", "tudf_m"}
KEYS |= {*Difficulty._fields}


def make(folder, *, compact=False, shards=None):
    recipe = picky_recipe()
    plan = plan_of(folder, recipe, counts=COUNTS, shard_samples=3, compact=compact)
    build(plan, workers=1, shard_range=shards)
    return folder


def fields(folder, split):
    """All samples of a split, as its files hold them."""
    files = sorted(folder.glob(f"{split}-*.h5"))
    opened = [h5py.File(file, "r") for file in files]
    found = {name: np.concatenate([file[name][:] for file in opened]) for name in opened[0]}
    for file in opened:
        file.close()
    return found


def recomputed(stored, chosen):
    """Each figure of each chosen sample, loop by loop."""
    rows = {key: [] for key in KEYS}
    for n in chosen:
        finite = [float(r) for r in stored["ranges"][n].ravel() if r < np.inf]
        rows["returned"].append(len(finite) / stored["ranges"][n].size)
        if finite:
            rows["range_m"].append(sum(finite) / len(finite))
        for key, name in (("occupied", "occupancy"), ("observed", "observed"), ("free", "free")):
            rows[key].append(int((stored[name][n] != 0).sum()) / stored[name][n].size)
        rows["unknown"].append(1 - rows["observed"][-1] - rows["free"][-1])
        rows["tudf_m"].append(
            float(stored["tudf"][n].astype(np.float64).sum()) / stored["tudf"][n].size
        )
        hard = difficulty(stored["occupancy"][n].astype(bool), stored["tudf"][n], 0.2)
        for key, value in hard._asdict().items():
            rows[key] += [] if np.isnan(value) else [value]
    return rows


def check(statistics, rows):
    assert set(statistics) == KEYS
    for key, values in rows.items():
        mean = sum(values) / len(values)
        expected = {
            "mean": mean,
            "std": (sum((value - mean) ** 2 for value in values) / len(values)) ** 0.5,
            "min": min(values),
            "max": max(values),
        }
        assert set(statistics[key]) == set(expected)
        for name, value in expected.items():
            assert statistics[key][name] == pytest.approx(value, rel=1e-5, abs=1e-7), (key, name)


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    return make(tmp_path_factory.mktemp("inspect") / "full")


def test_statistics_are_those_of_the_files(full):
    found = inspect(full)
    assert list(found["splits"]) == ["train", "test"]
    for name, split in found["splits"].items():
        stored = fields(full, name)
        assert split["samples"] == split["sampled"] == len(stored["world"]) == COUNTS[name]
        assert split["worlds"] == len(set(stored["world"].tolist()))
        check(split["statistics"], recomputed(stored, np.arange(COUNTS[name])))
        assert all(split["statistics"][key]["std"] > 0 for key in KEYS - set(Difficulty._fields))


def test_counts_sizes_and_origin_are_those_of_the_folder(full):
    found = inspect(full)
    manifest = json.loads(next(full.glob("*.json")).read_text())
    assert found["samples"] == sum(COUNTS.values())
    assert found["bytes"] == sum(len(path.read_bytes()) for path in full.iterdir())
    assert found["bytes_per_sample"] == pytest.approx(found["bytes"] / sum(COUNTS.values()))
    for name in ("kind", "seed", "complete", "digest", "fields", "grid", "rejected"):
        assert found[name] == manifest[name]
    assert found["complete"] is True


@pytest.mark.parametrize("most", [1, 4, 200])
def test_at_most_so_many_samples_are_measured_evenly_spread(full, most):
    split = inspect(full, most=most)["splits"]["train"]
    count = min(most, COUNTS["train"])
    assert split["sampled"] == count
    assert split["samples"] == COUNTS["train"]
    chosen = [
        n * (COUNTS["train"] - 1) // max(count - 1, 1) for n in range(count)
    ]  # from the first to the last
    check(split["statistics"], recomputed(fields(full, "train"), np.array(chosen)))


def test_many_samples_are_measured_by_several_processes_some_at_a_time(full, monkeypatch):
    monkeypatch.setattr("scenegen.display.inspect.AT_ONCE", 4)
    few, told = inspect(full, most=None, workers=2), []
    assert few == inspect(full, most=None, workers=1, on_done=told.append)
    assert sum(told) == sum(COUNTS.values())
    assert len(told) > 3
    for name, split in few["splits"].items():
        check(split["statistics"], recomputed(fields(full, name), np.arange(COUNTS[name])))


def test_figures_and_samples_are_told_by_kind(tmp_path, capsys):
    (tmp_path / "r.toml").write_text(RECIPE)
    options = {"n": 20, "val": 0, "test": 0, "workers": 1}
    mixed = scenegen.generate(recipe=tmp_path / "r.toml", out=tmp_path / "d", **options)
    shown, _ = looks(mixed, "train", range(20))
    assert [shown[n].name for n in (0, 19)] == ["train 0, pillar", "train 19, maze-hard"]
    for most, chosen in ((20, range(20)), (3, (0, 9, 19))):
        for kind, told in inspect(mixed.folder, most=most)["splits"]["train"]["kinds"].items():
            own = [shown[n] for n in chosen if shown[n].name.endswith(kind)]
            known = [look.masks["observed"] | look.masks["free"] for look in own]
            assert told["sampled"] == len(own)
            found = told["statistics"]
            assert found["unknown"]["mean"] == pytest.approx(1 - np.mean(known))
            assert found["tudf_m"]["mean"] == pytest.approx(np.mean([look.tudf for look in own]))
    assert "means of each kind" in run(capsys, f"inspect {mixed.folder}")[1]


def test_figures_that_are_kept_are_read_and_no_others(full, tmp_path, monkeypatch, capsys):
    """A table for another dataset has another name; a cut one is measured anew."""
    folder = shutil.copytree(full, tmp_path / "kept")
    words = f"take {folder} --where visibility_m>2.2 -o {tmp_path}"
    assert run(capsys, f"{words}/measured")[0] == 0
    assert run(capsys, f"inspect {folder} --keep")[0] == 0
    every = inspect(full, most=None)["splits"]
    (told,) = folder.glob("figures-*.json")
    assert json.loads(told.read_text()) == every
    (file,) = folder.glob("figures-*.npy")
    content = file.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr("scenegen.dataset.choose.difficulty", None)  # nothing measures
        assert inspect(folder, most=1)["splits"] == every
        assert run(capsys, f"{words}/read")[0] == 0
    taken = [Dataset(tmp_path / name).manifest.digest for name in ("read", "measured")]
    assert taken[0] == taken[1]
    stored = fields(full, "train")
    shares = {n: stored["occupancy"][stored["world"] == n].mean() for n in set(stored["world"])}
    least = sorted(shares.values())[1] - 1e-9
    assert every["train"]["world_means"]["occupied"]["max"] == pytest.approx(max(shares.values()))
    words = f"--split train --where world_occupied>={least} -o {tmp_path}"
    assert run(capsys, f"take {folder} {words}/worlds")[0] == 0
    worlds, _ = Dataset(tmp_path / "worlds").split("train").numbers
    assert set(worlds) == {n for n, share in shares.items() if share > least}
    assert "--keep" in run(capsys, f"take {full} {words}/none")[2]
    for damaged in (content[:-1], b"x" + content[1:]):
        file.write_bytes(damaged)
        assert inspect(folder, most=1)["splits"]["train"]["sampled"] == 1


def test_a_split_without_returns_gives_valid_json(tmp_path, capsys):
    folder = make(tmp_path / "d")
    for file in sorted(folder.glob("test-*.h5")):
        with h5py.File(file, "r+") as opened:
            opened["ranges"][:] = np.inf
    found = inspect(folder)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    statistics = found["splits"]["test"]["statistics"]
    assert statistics["range_m"] == {"mean": None, "std": None, "min": None, "max": None}
    assert statistics["returned"] == {"mean": 0, "std": 0, "min": 0, "max": 0}
    assert statistics["occupied"]["mean"] > 0
    for words in ("--json", ""):
        code, said, _ = run(capsys, f"inspect {folder} {words}")
        assert code == 0
        assert "nan" not in said.lower()


def test_a_folder_of_datasets_is_listed(full, tmp_path, capsys):
    shutil.copytree(full, tmp_path / "good")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "dataset.json").write_text("{")
    (tmp_path / "else").mkdir()
    code, said, _ = run(capsys, f"inspect {tmp_path} --json")
    assert code == 0
    bad, good = json.loads(said)
    assert good["samples"] == COUNTS
    assert good["digest"] == inspect(full)["digest"]
    assert "dataset.json" in bad["fault"]
    code, said, _ = run(capsys, "inspect", tmp_path)
    assert (code, said.count("\n")) == (0, 2)


def test_what_does_not_fit_is_told(full, capsys):
    """Shares of the map against a count of random places."""
    rng = np.random.default_rng(0)
    for shape, reach in (((80, 80, 40), 10.0), ((255, 255, 64), 10.0), ((80, 80, 80), 6.0)):
        grid = GridSpec(shape=shape)
        places = rng.uniform(-0.5, 0.5, (20_000, 3)) * grid.extent_m
        beyond = (np.linalg.norm(places, axis=1) > reach).mean()
        told = misfits(grid, Lidar(max_range_m=reach))
        assert bool(told) == (beyond > 0.4)
        if told:
            assert abs(float(told[0].split()[0]) - 100 * beyond) < 4
    code, _, noted = run(capsys, f"inspect {full}")
    assert (code, noted) == (0, "")


def test_a_world_is_told(tmp_path, capsys):
    (tmp_path / "w.xml").write_text(
        "<mujoco><worldbody><geom size='1' pos='0 0 5'/><geom type='box' size='1 1 1'/>"
        "<geom type='box' size='9 9 .1'/></worldbody></mujoco>"
    )
    code, said, _ = run(capsys, f"inspect {tmp_path}/w.xml --json")
    assert code == 0
    assert json.loads(said)["solids"] == {"sphere": 1, "box": 2}
