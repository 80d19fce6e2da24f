"""Maps of real places as worlds: what is free, what is flown through, and datasets of them."""

import json

import numpy as np
import pytest

import scenegen
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN
from scenegen.base.errors import SceneError
from scenegen.dataset.generation import plan_generation
from scenegen.dataset.read import Dataset
from scenegen.publish.stage import Request, stage
from scenegen.verification import verify
from scenegen.worlds.place import parse_npz, read_place
from tests.command_line import done, refused, run
from tests.scenegen import cases, refuses
from tests.scenegen.conftest import built
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

RECIPE = """
kind = "scene"
[grid]
shape = [40, 40, 16]
voxel_m = 0.4
[lidar]
rows = 8
columns = 60
"""
VOXEL_M, ORIGIN = 0.25, (-3.0, 2.0, 0.0)


def hall(seed=0):
    """A hall of 24 × 24 × 6 m with columns, closed but for its ceiling, of whose one corner nothing
    is known."""
    rng = np.random.default_rng(seed)
    states = np.full((96, 96, 24), FREE, np.uint8)
    for x, y in rng.integers(4, 90, (25, 2)):
        states[x : x + 3, y : y + 3] = OCCUPIED
    states[:, :, 0] = states[0] = states[-1] = states[:, 0] = states[:, -1] = OCCUPIED
    states[70:95, 70:95, 1:] = UNKNOWN
    return states


def write_map(path, states, **other):
    given = {"states": states, "voxel_m": np.float64(VOXEL_M), "origin": np.array(ORIGIN)}
    np.savez(path, **given | other)  # type: ignore[arg-type]
    return path


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return read_place(write_map(tmp_path_factory.mktemp("map") / "hall.npz", hall()))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Maps and one MJCF file, dealt to the three splits."""
    folder = tmp_path_factory.mktemp("places")
    for seed in range(3):
        write_map(folder / f"hall-{seed}.npz", hall(seed))
    (folder / "room.xml").write_text(
        "<mujoco><worldbody><geom type='plane' size='0 0 1'/><geom type='box' size='1 9 3' "
        "pos='9 0 3'/><geom type='box' size='9 1 3' pos='0 9 3'/></worldbody></mujoco>"
    )
    (folder / "recipe.toml").write_text(RECIPE)
    return built(planned(folder, folder / "data", shard_samples=10), workers=1).folder


def planned(folder, out, **more):
    recipe = folder / "recipe.toml"
    counts = {"n": 20, "val": 5, "test": 5}
    (plan,) = plan_generation(scene=folder, recipe=recipe, out=out, **counts, **more).datasets
    return plan


def test_clearance_is_the_distance_to_the_nearest_voxel_that_is_not_free(place, rng):
    states = place.voxels.states
    cells = np.argwhere(np.pad(states, 6) != FREE) - 6  # beyond the map, nothing is free
    low = np.array(ORIGIN) + cells * VOXEL_M
    for point in rng.uniform(*place.voxels.bounds, (60, 3)):
        gaps = np.maximum(np.maximum(low - point, point - low - VOXEL_M), 0.0)
        expected = min(float(np.sqrt((gaps**2).sum(axis=1).min())), 1.0)
        assert place.clearance.at(*point) == pytest.approx(expected, abs=1e-9)


def test_flight_bounds_are_those_of_the_free_voxels(place):
    low, high = place.flight_bounds
    assert low == pytest.approx(np.array(ORIGIN) + VOXEL_M)
    assert high == pytest.approx(np.array(ORIGIN) + VOXEL_M * np.array([95, 95, 24]))


def test_a_dataset_of_maps_passes_every_check(dataset):
    report = verify(dataset)
    assert report.ok, report.failed
    counts = {check.name: check.counts for check in report.checks}
    assert counts["occupancy"]["samples"] == 30
    assert counts["rays"]["rays"] == counts["known"]["samples"] * 480 > 0


@pytest.mark.parametrize("name", ["least_share", "most_marked_share"])
def test_a_viewpoint_of_which_too_little_is_known_is_caught(dataset, tmp_path, name):
    folder = forge.copy(dataset, tmp_path / "d")
    forge.edit_at(folder, f"recipe.known.{name}", "0.99" if name == "least_share" else "0.0")
    forge.sign(folder)
    (told,) = failed(folder, quick=True).items()
    assert (told[0], f"known.{name} = 1" in told[1] or "0.99" in told[1]) == ("accepted", True)


def test_what_is_occupied_and_not_known_is_caught(dataset, tmp_path):
    def forget(arrays):
        arrays["known"][3] &= ~arrays["occupancy"][3]

    folder = forge.copy(dataset, tmp_path / "d")
    forge.edit(folder, "train-00000.h5", forget)
    told = failed(folder, quick=True)["laws"]
    assert told.startswith("train-00000.h5: sample 3: ")
    assert told.endswith(" voxels are occupied and not known")


def test_a_dataset_of_maps_is_published(undrawn, dataset, tmp_path):
    out = tmp_path / "out"
    staged = stage(Request(dataset=dataset, repository="ada/hall", out=out), ())
    assert staged.digest == str(Dataset(dataset).manifest.digest)
    assert "places or people, only their publisher can say" in (out / "README.md").read_text()


def test_samples_say_what_is_known(dataset):
    shares = []
    for split in ("train", "val", "test"):
        for sample in scenegen.load(dataset, split=split):
            assert (sample.known | ~sample.occupancy).all()
            assert sample.ray_known.mean() >= 0.65
            shares.append(sample.known.mean())
    assert min(shares) >= 0.05
    assert min(shares) < 0.6
    assert max(shares) == 1.0  # all of the MJCF file's world is known


def test_of_a_map_more_flights_are_drawn_where_nobody_says_how_many(dataset, tmp_path):
    few, long = "[accept]\nmax_draws = 60", "[flight]\niterations = 1000000"
    recipe = tmp_path / "r.toml"
    for asked, draws in (("", 500), (few, 60), (long, 50)):
        recipe.write_text(RECIPE + asked)
        asked = {"scene": dataset.parent, "recipe": recipe, "out": tmp_path / "d"}
        (plan,) = plan_generation(None, 1, **asked).datasets
        assert plan.manifest.tables.accept["max_draws"] == draws


def test_bench_scores_what_is_known(dataset, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("scenegen.model.bench.shown._webp", lambda figure: b"")
    out = tmp_path / "bench"
    words = f"bench {dataset} --quick --split train --workers 1 --method truth --method extrude"
    said = done(capsys, f"{words} -o {out}")
    report = json.loads((out / "report.json").read_text())
    assert report["planning"]["scene"]["truth"]["success"]["mean"] > 0.8
    assert report["reconstruction"]["scene"]["truth"]["iou"]["mean"] == 1.0
    assert report["reconstruction"]["scene"]["extrude"]["iou"]["mean"] < 1.0
    about = report["datasets"]["scene"]
    known = [sample.known for sample in scenegen.load(dataset, split="train")]
    assert about["samples"] == len(known)
    assert about["known_share"] == pytest.approx(np.mean(known))
    for text in (said, (out / "report.md").read_text(), (out / "report.html").read_text()):
        assert about["note"] in text
    assert about["note"].startswith(f"{100 * about['known_share']:.1f} % of the grid is known")
    assert run(capsys, f"bench {dataset} --reliability -o {out}")[0] == 1


def test_what_a_map_lacks_ends_in_a_line(dataset, tmp_path, capsys):
    words = f"generate --scene {dataset.parent}/hall-0.npz -o {tmp_path}/no"
    for part in ("--labels class", "--normals"):
        assert "is a map of voxels" in refused(capsys, f"{words} {part}")
    assert "no engine but its own" in refused(capsys, f"{words} --engine mujoco")
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(("name", "value", "said"), cases("worlds/place"))
def test_a_damaged_npz_map_ends_in_a_line(tmp_path, name, value, said):
    kind = np.uint8 if name == "states" else np.float64
    changed = {"states": hall(), name: np.array(json.loads(value), kind)}
    path = write_map(tmp_path / "map.npz", **changed)
    with pytest.raises(SceneError, match=said) as raised:
        read_place(path)
    assert "map.npz" in str(raised.value)


def test_an_npz_of_something_else_is_no_map(tmp_path):
    np.savez(tmp_path / "scan.npz", points=np.zeros((4, 3)))
    for content in ((tmp_path / "scan.npz").read_bytes(), b"", b"PK\x03\x04" * 9):
        refuses(r"not an \.npz map", parse_npz, content, "scan.npz")
