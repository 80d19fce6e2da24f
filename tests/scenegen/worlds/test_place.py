"""Maps of real places as worlds: what is free, what is flown through, and datasets of them."""

import json
from itertools import pairwise

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812 (its usual name)
from scipy.spatial import cKDTree

import scenegen
from lidarsim import Lidar, Pose, cast
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN
from scenegen.base.errors import SceneError
from scenegen.dataset.generation import plan_generation
from scenegen.dataset.read import Dataset
from scenegen.draw.sample import rng_of
from scenegen.draw.scored import scored_voxels
from scenegen.model.bench.methods import Truth, find_method
from scenegen.model.bench.metrics import METRICS, measure
from scenegen.model.bench.planner import plan_path, refine
from scenegen.model.bench.report import build_report, tables
from scenegen.model.bench.run import bench, trials_of
from scenegen.model.bench.visibility import Case
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import BenchConfig, LossConfig, NetworkConfig, TrainConfig
from scenegen.model.losses import Coupled
from scenegen.model.network import Output
from scenegen.model.training.data import Maps, load, opened
from scenegen.model.training.loop import train
from scenegen.publish.stage import Request, stage
from scenegen.truth import distance_field
from scenegen.verification import verify
from scenegen.verification.rays import MapAuditor
from scenegen.view.look import Guess, look_into
from scenegen.view.page import packed
from scenegen.worlds.flight import Flight, fly
from scenegen.worlds.place import parse_npz, read_place
from tests.command_line import done, refused, rows, run
from tests.model.bench.test_bench import hits_of
from tests.scenegen.conftest import built
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed
from tests.scenegen.view.test_page import unpacked

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


def test_flights_keep_their_clearance_and_stay_near(place):
    rng, flown = np.random.default_rng(0), 0
    flight = Flight(robot_radius_m=0.3)
    for _ in range(10):
        path = fly(place, flight, rng=rng)
        if path is None:
            continue
        flown += 1
        assert (np.ptp(path, axis=0) <= 2 * 1.5 * flight.min_distance_m).all()
        for a, b in pairwise(path):
            for share in np.linspace(0, 1, 50):
                assert place.clearance.at(*(a + share * (b - a))) >= 0.3 - 1e-3
    assert flown >= 5


def test_flight_bounds_are_those_of_the_free_voxels(place):
    low, high = place.flight_bounds
    assert low == pytest.approx(np.array(ORIGIN) + VOXEL_M)
    assert high == pytest.approx(np.array(ORIGIN) + VOXEL_M * np.array([95, 95, 24]))


@pytest.mark.parametrize("scale", [1.0, 0.31])
def test_another_way_to_cast_finds_the_same_ranges(place, scale):
    lidar, rng = Lidar(max_range_m=20 * scale), np.random.default_rng(1)
    for point in rng.uniform(*place.voxels.bounds, (8, 3)):
        pose = Pose.level(point, float(rng.uniform(0, 7)))
        scan = cast(place.caster(None), lidar, pose)
        rays, ranges = scan.directions.reshape(1, -1, 3), scan.ranges.reshape(-1)
        again = MapAuditor(place.voxels).cast(point[None], rays, lidar.max_range_m)[0]
        met = np.isfinite(ranges)
        assert (met == np.isfinite(again)).all()
        assert ranges[met] == pytest.approx(again[met], abs=1e-5)


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


def test_the_same_bits_however_they_are_made(dataset, tmp_path):
    again = built(planned(dataset.parent, tmp_path / "again", shard_samples=5), workers=2)
    assert again.manifest.digest == Dataset(dataset).manifest.digest


def test_a_stream_mixes_maps_with_drawn_worlds(dataset):
    mixed = scenegen.stream([str(dataset.parent / "hall-0.npz"), "pillar"], seed=0, samples=10)
    assert {bool(sample.known.all()) for sample in mixed} == {True, False}


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


def test_planning_in_a_place_is_scored_with_unknown_voxels_marked_and_not_marked(dataset):
    """As computed from the paths of a planner that holds nothing for occupied, or the unknown."""
    places = Dataset(dataset)
    config = BenchConfig(split="train", trials=600)
    result = bench(places, [find_method("empty"), Truth()], config)
    split, grid = places.split("train"), places.grid
    rows = {"trials": [], "unmarked": []}
    for index, turn in result.trial_places:
        sample = split[index]
        case = Case(sample, index, split)
        goal = trials_of(case, config.plan, turn + 1, rng_of(config.seed, index)).goals[turn]
        for which, blocked in (
            ("trials", ~sample.known), ("unmarked", np.zeros(grid.shape, bool)),
        ):  # fmt: skip
            plan = plan_path(blocked, goal, grid, config.plan)
            path = refine(plan.waypoints, distance_field(blocked, grid), grid, config.plan)
            solid = hits_of(path, sample.occupancy | ~sample.known, grid)
            known = sample.occupancy[tuple(solid.T)]
            rows[which].append((len(solid) == 0, known.any()))
    empty, truth = result.methods.values()
    for which, found in (("trials", empty), ("unmarked", empty.without_marks)):
        assert [*zip(found.values("success"), found.values("hits"), strict=True)] == rows[which]
    assert rows["trials"] != rows["unmarked"]
    assert truth.without_marks.values("success").mean() < truth.values("success").mean()
    report = build_report([result], seed=0, about={})
    shown = {name: metrics for name, metrics, *_ in tables(report, "scene")}
    names = ("planning, known space not marked", "planning, known space marked")
    assert tuple(shown)[1:] == names
    assert all(next(iter(shown[name])) == "hits" for name in names)
    unmarked = report["planning"]["scene"]["empty"]["unmarked"]["hits"]["mean"]
    assert unmarked == pytest.approx(np.mean([hit for _, hit in rows["unmarked"]]))
    tests = {test["metric"]: test["difference"] for test in report["tests"]["scene"]}
    gained = empty.without_marks.values("hits") - truth.without_marks.values("hits")
    assert tests["unmarked_hits"] == pytest.approx(gained.mean())


def test_pages_and_pictures_score_known_voxels_as_the_bench_does(dataset):
    """A prediction that holds all unknown space for occupied, which nobody can judge."""
    places = Dataset(dataset)
    split = places.split("train")
    index = int(np.argmin([sample.known.mean() for sample in split]))
    sample, grid = split[index], places.grid
    occupied = sample.observed | ~sample.known
    prediction = Prediction(occupancy_probability=occupied.astype(np.float32))
    guess = Guess(name="a", occupied=occupied, tudf=None)
    look = look_into(split, index, lambda *of: [guess])
    shown = scenegen.show(sample, prediction, out=dataset.parent / "shown.html")
    known, truth = sample.known, sample.occupancy
    both = np.count_nonzero(occupied & truth & known)
    either = np.count_nonzero((occupied | truth) & known)
    missed = np.count_nonzero(truth & ~occupied & known)
    invented = np.count_nonzero(occupied & ~truth & known)
    assert invented < np.count_nonzero(occupied & ~truth) / 2
    # known to be within the truncation, for no voxel of unknown space is nearer
    unknown = grid.centres(np.zeros(3))[~known]
    gaps = cKDTree(unknown).query(grid.centres(np.zeros(3)).reshape(-1, 3))[0].reshape(grid.shape)
    certain = sample.tudf <= np.minimum(gaps, grid.truncation_m) + 1e-6
    for seen, name in ((look, "a"), (shown.looks[0], "prediction")):
        figures = seen.figures()
        iou = f"IoU {both / either:.3f}"
        assert figures[name] == f"{iou}, {missed} missed, {invented} invented"
        assert seen.iou(seen.guesses[0]) == iou
        assert figures["known"] == f"{100 * known.mean():.2f} %"
        assert figures["occupancy"] == f"{100 * truth[known].mean():.2f} % of known voxels"
        assert figures["mean distance"] == f"{sample.tudf[certain].mean():.2f} m where certain"
    data = packed(look)
    for name, mask in (("scored", known), ("certain", certain)):
        bits = np.unpackbits(np.frombuffer(unpacked(data[name]), np.uint8))[: mask.size]
        assert (bits.reshape(mask.shape) == mask).all()
    scored = scored_voxels(sample, grid, split.home(index).tables.world)
    measured = measure(
        occupied, sample.tudf, truth, sample.tudf,
        classes=np.where(scored, np.uint8(0), np.uint8(255)), class_count=1,
    )[0]  # fmt: skip
    assert measured[[*METRICS].index("iou")] == pytest.approx(both / either)


def test_networks_learn_from_what_is_known(dataset, tmp_path):
    maps = Maps(opened([dataset], "train"), "train")
    batch = next(load(maps, [[0, 1]], workers=0, pinned=False))
    known, certain = batch["known"], batch["certain"]
    assert known.float().mean() < 0.9
    assert (certain & known).any()
    rng = torch.Generator().manual_seed(0)
    said = [torch.randn(known.shape, generator=rng, requires_grad=True) for _ in range(2)]
    loss = Coupled(LossConfig(lovasz=1.0), maps.grid)
    loss(Output(*said), batch)["loss"].backward()
    assert not said[0].grad[~known].any()
    assert said[0].grad[known].all()
    beside = F.max_pool3d(certain[:, None].float(), 3, 1, 1)[:, 0] > 0  # slopes see neighbours
    assert not said[1].grad[~beside].any()
    everything = {**batch, "known": torch.ones_like(known), "certain": torch.ones_like(known)}
    plain = {name: batch[name] for name in ("observed", "occupancy", "tudf")}
    both = [loss(Output(*said), one) for one in (everything, plain)]
    for name in both[0]:
        assert both[0][name].item() == pytest.approx(both[1][name].item())
    config = TrainConfig(network=NetworkConfig(variant="occ", width=4), maps=2, batch=2)
    checks = opened([dataset], "val")
    (row,) = train(opened([dataset], "train"), checks, config, tmp_path / "run", device="cpu")
    assert 0 <= row["val_iou"] <= 1


def test_what_a_map_lacks_ends_in_a_line(dataset, tmp_path, capsys):
    words = f"generate --scene {dataset.parent}/hall-0.npz -o {tmp_path}/no"
    for part in ("--labels class", "--normals"):
        assert "is a map of voxels" in refused(capsys, f"{words} {part}")
    assert "no engine but its own" in refused(capsys, f"{words} --engine mujoco")
    assert not (tmp_path / "no").exists()


DAMAGED = """
states  → [[[3]]]        → 0, 1 and 2
states  → [[1]]          → expected uint8 of 3 axes
voxel_m → 0              → a voxel of 0 m
origin  → [0.0, NaN, 0]  → three finite
states  → [[[0]]]        → nothing in it is free
"""


@pytest.mark.parametrize(("name", "value", "said"), rows(DAMAGED))
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
        with pytest.raises(SceneError, match=r"not an \.npz map"):
            parse_npz(content, "scan.npz")
