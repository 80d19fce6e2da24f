"""Maps of real places as worlds: what is free, what is flown through, and datasets of them."""

import itertools
import json

import numpy as np
import pytest
from scipy.ndimage import label

import scenegen
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelMap
from scenegen import SPLITS
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.generation import plan_generation
from scenegen.dataset.like import plan_like
from scenegen.draw.source import SceneWorlds
from scenegen.publish.stage import Request, stage
from scenegen.verification import verify
from scenegen.worlds.place import PlaceClearance, parse_npz, read_place
from scenegen.worlds.recipe import read_recipe
from scenegen.worlds.scene import load_map
from tests.command_line import done, run
from tests.refusals import refuses, refuses_command
from tests.scenegen import each_case
from tests.scenegen.conftest import built
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed, finds

RECIPE = """
kind = "scene"
grid.shape = [40, 40, 16]
grid.voxel_m = 0.4
lidar.rows = 8
lidar.columns = 60
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


def write_map(path, states, **changed):
    arrays = {"states": states, "voxel_m": np.float64(VOXEL_M), "origin": np.array(ORIGIN)}
    np.savez(path, **arrays | changed)  # type: ignore[arg-type]
    return path


def plan_of(folder, scene, n, more="", **options):
    """The plan of a dataset of maps, by a recipe that has more."""
    (recipe := folder / "r.toml").write_text(RECIPE + more)
    options = {"scene": scene, "recipe": recipe, "out": folder / "d", **options}
    (plan,) = plan_generation(None, n, **options).datasets
    return plan


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
    return built(plan_of(folder, folder, 10, val=4, test=4, shard_samples=10)).folder


def test_flights_keep_away_from_voxels_not_free(tmp_path, rng):
    place = read_place(write_map(tmp_path / "hall.npz", hall()))
    cells = np.argwhere(np.pad(place.voxels.states, 6) != FREE) - 6  # beyond it, nothing is free
    low = np.array(ORIGIN) + cells * VOXEL_M
    for point in rng.uniform(*place.voxels.bounds, (60, 3)):
        gaps = point - np.clip(point, low, low + VOXEL_M)
        nearest = min(np.linalg.norm(gaps, axis=1).min(), 1.0)
        assert place.clearance.at(*point) == pytest.approx(nearest, abs=1e-9)
    corners = np.array([[1, 1, 1], [95, 95, 24]])
    assert place.flight_bounds == pytest.approx(ORIGIN + VOXEL_M * corners)


def test_a_dataset_of_maps_passes_every_check(dataset):
    report = verify(dataset)
    assert report.ok, report.failed
    counts = {check.name: check.counts for check in report.checks}
    assert counts["occupancy"]["samples"] == 18
    assert counts["rays"]["rays"] == counts["known"]["samples"] * 480 > 0


@pytest.mark.parametrize(("name", "value"), [("least_share", "0.99"), ("most_marked_share", "0.0")])
def test_viewpoints_too_little_known_are_caught(dataset, tmp_path, name, value):
    folder = forge.copy(dataset, tmp_path / "d")
    forge.sign(forge.edit_at(folder, f"recipe.known.{name}", value))
    assert list(failed(folder, quick=True)) == ["accepted"]


def test_what_is_occupied_and_not_known_is_caught(dataset, tmp_path):
    def forget(arrays):
        arrays["known"][3] &= ~arrays["occupancy"][3]

    folder = forge.copy(dataset, tmp_path / "d")
    forge.edit(folder, "train-00000.h5", forget)
    finds("forgotten", folder, "laws", quick=True)


def test_a_dataset_of_maps_is_published(undrawn, dataset, tmp_path):
    request = Request(dataset=dataset, repository="ada/hall", out=tmp_path / "out")
    stage(request, ())
    card = (request.out / "README.md").read_text()
    assert "places or people, only their publisher can say" in card


@each_case("worlds/draws", "more draws")
def test_maps_get_more_draws_by_default(tmp_path, more, draws):
    plan = plan_of(tmp_path, write_map(tmp_path / "hall.npz", hall()), 1, more, val=0, test=0)
    assert plan.manifest.tables.accept["max_draws"] == int(draws)


def test_bench_scores_what_is_known(dataset, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("scenegen.model.bench.shown.draw_failures", lambda *given: [])
    out = tmp_path / "bench"
    words = f"bench {dataset} --quick --split train --workers 1 --method truth --method extrude"
    printed = done(capsys, f"{words} -o {out}")
    report = json.loads((out / "report.json").read_text())
    assert report["planning"]["scene"]["truth"]["success"]["mean"] > 0.8
    rows = report["reconstruction"]["scene"]
    assert rows["extrude"]["iou"]["mean"] < rows["truth"]["iou"]["mean"] == 1.0
    known = np.mean([sample.known for sample in scenegen.load(dataset, split="train")])
    assert report["datasets"]["scene"]["known_share"] == pytest.approx(known)
    assert f"{100 * known:.1f} % of the grid is known" in printed
    assert run(capsys, f"bench {dataset} --reliability -o {out}")[0] == 1


@pytest.mark.parametrize("option", ["--labels class", "--normals", "--engine mujoco"])
def test_what_a_map_lacks_is_refused(tmp_path, capsys, option):
    scene, out = write_map(tmp_path / "hall.npz", hall()), tmp_path / "no"
    refuses_command(capsys, f"generate --scene {scene} -o {out} {option}")
    assert not out.exists()


def plot():
    """A stand of 9 × 8 × 4 m: trunks .5 m apart, undergrowth, unknown pockets."""
    rng, states = np.random.default_rng(1), np.full((90, 80, 40), FREE, np.uint8)
    x, y = np.mgrid[0:90:5, 0:80:5] + rng.integers(0, 3, (2, 18, 16))
    states[x, y] = OCCUPIED
    for x, y, z in rng.integers(0, (85, 75, 35), (15, 3)):
        states[x : x + 3, y : y + 3, z : z + 3] = UNKNOWN
    states[:, :, :2] = OCCUPIED
    return states


def planned(folder, flight=""):
    """The plan of a dataset in the plot."""
    scene = write_map(folder / "plot.npz", plot(), voxel_m=np.float64(0.1))
    return plan_of(folder, scene, 5, f"known.most_marked_share = 0.9\n{flight}", val=0, test=0)


def test_radius_and_altitudes_are_found_in_a_dense_plot(tmp_path):
    plan = planned(tmp_path)
    flight = plan.manifest.recipe.flight
    low, high = flight.altitude_m
    assert 0.05 < flight.robot_radius_m < 0.3
    assert 0.0 < low < high < 4.1
    assert len(built(plan).split("train")) == 5
    kept = planned(tmp_path, "flight.altitude_m = [1.0, 2.0]").manifest.recipe.flight
    assert kept.altitude_m == (1.0, 2.0)


@pytest.mark.parametrize("flight", ["robot_radius_m = 0.4", "altitude_m = [8.0, 9.0]"])
def test_what_fits_nowhere_is_named_with_what_would(tmp_path, flight):
    refuses(flight, planned, tmp_path, f"flight.{flight}")


def test_the_widest_way_is_that_of_thresholds(rng):
    states = np.where(rng.random((14, 13, 12)) < 0.02, OCCUPIED, FREE).astype(np.uint8)
    clearance = PlaceClearance(VoxelMap(states, 0.5, np.zeros(3)), False)
    cells = np.argwhere(np.ones(states.shape))
    free = np.array([clearance.at(*middle) for middle in (cells + 0.5) * 0.5])
    for begin in np.argwhere(states == FREE)[::200]:
        far = np.linalg.norm(cells - begin, axis=1) >= 8
        here = (cells == begin).all(axis=1)
        widest = 0.0
        for width in np.unique(free[free > 0]):
            parts = label((free >= width).reshape(states.shape))[0].ravel()
            if parts[here] and parts[here] in parts[far]:
                widest = width
        assert clearance.width_m((begin + 0.5) * 0.5, 4.0, 1.0) == pytest.approx(widest)


def test_a_single_map_is_cut_into_regions(tmp_path):
    scene = write_map(tmp_path / "hall.npz", np.concatenate([hall(), hall(1), hall(2)]))
    data = built(plan_of(tmp_path, scene, 10))
    assert [len(data.split(split)) for split in SPLITS] == [10, 1, 2]
    regions = [data.compile(split, 0).voxels for split in SPLITS]
    counts = [np.count_nonzero(region.states == FREE) for region in regions]
    assert counts[0] == pytest.approx(3 * counts[1], rel=0.3)
    for first, second in itertools.pairwise(regions):
        assert second.bounds[0, 0] - first.bounds[1, 0] >= 1.0
    report = verify(data.folder)
    assert report.ok, report.failed


def test_regions_that_overlap_are_caught(tmp_path):
    """As of two cuts of one map."""
    halls = np.concatenate([hall(), hall(1)])
    train, val = (
        (load_map(write_map(tmp_path / "hall.npz", states)),) for states in (halls, halls[:-1])
    )
    (tmp_path / "r.toml").write_text(RECIPE)
    worlds = SceneWorlds({"train": train, "val": val, "test": ()})
    source, recipe = worlds.suited(read_recipe(tmp_path / "r.toml"))
    counts = {"train": 5, "val": 5, "test": 0}
    data = built(plan_dataset(tmp_path / "d", recipe, source, seed=0, counts=counts))
    assert "hall.npz" in failed(data.folder)["splits"]


@each_case("worlds/place", "name value")
def test_damaged_npz_maps_are_refused(tmp_path, name, value):
    kind = np.uint8 if name == "states" else np.float64
    changed = {"states": hall(), name: np.array(json.loads(value), kind)}
    path = write_map(tmp_path / "map.npz", **changed)
    assert "map.npz" in refuses(f"{name} {value}", read_place, path)


def test_an_npz_of_something_else_is_no_map(tmp_path):
    np.savez(tmp_path / "scan.npz", points=np.zeros((4, 3)))
    np.savez(tmp_path / "part.npz", states=hall())
    scan, part = ((tmp_path / name).read_bytes() for name in ("scan.npz", "part.npz"))
    for case, content in {
        "scan": scan,
        "part": part,
        "empty": b"",
        "damaged": b"PK\x03\x04" * 9,
    }.items():
        refuses(case, parse_npz, content, "scan.npz")


def test_flights_in_maps_are_flown_again_for_more_scans(tmp_path):
    scene = write_map(tmp_path / "hall.npz", hall())
    once = built(plan_of(tmp_path, scene, 4, val=0, test=0))
    twice = built(
        plan_of(tmp_path, scene, 4, "mapping.scans = 2", val=0, test=0, out=tmp_path / "2")
    )
    like = build(plan_like(once.folder, tmp_path / "like", mapping={"scans": 2}))
    assert like.digest == twice.digest != once.digest
