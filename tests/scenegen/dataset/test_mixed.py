"""Datasets of several kinds: shares, kinds told apart, the same samples as by themselves, resuming,
and what is wrong in one line."""

import re

import numpy as np
import pytest
from scenegen.dataset.choose import Choice
from scenegen.dataset.gather import plan_merge, plan_take
from scenegen.dataset.parts import write_rays
from scenegen.share.regenerate import recipe_text

import scenegen
from lidarsim import fuse
from scenegen.dataset import manifest, trust
from scenegen.dataset.generation import plan_generation, read_components
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError, RecipeError
from scenegen.model.training.data import Maps, SplitSamples
from scenegen.recipes import kind_names
from scenegen.share.stage import Request, stage
from scenegen.verification import verify
from tests.command_line import done, refused, rows
from tests.conftest import plan_of
from tests.scenegen.conftest import built

SMALL = """
kind = "mixed"
[grid]
shape = [24, 24, 16]
[flight]
viewpoints = 2
[accept]
min_solids = 0
min_occupied_share = 0
min_returned_share = 0
"""
RECIPE = f"""{SMALL}[[component]]
kind = "pillar"
weight = 3
[component.world]
density = [0.06, 0.06]
[[component]]
kind = "clutter"
weight = 1
[[component]]
kind = "maze"
difficulty = "hard"
weight = 1
"""
COUNTS = {"n": 20, "val": 5, "test": 5, "seed": 4}
DIFFERENT = f"""{SMALL}[[component]]
kind = "pillar"
weight = 3
[component.noise]
stages = "dropout:0.5"
[[component]]
kind = "clutter"
weight = 2
[component.lidar]
sensor = "velodyne-vlp-16"
[component.mapping]
scans = 2
[[component]]
kind = "maze"
difficulty = "hard"
weight = 1
[component.lidar]
sensor = "livox-mid-360"
"""
"""Components that differ in sensor, noise and scans."""


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    path = tmp_path_factory.mktemp("mixed") / "recipe.toml"
    path.write_text(RECIPE)
    return path


@pytest.fixture(scope="module")
def mixed(recipe):
    return scenegen.generate(recipe=recipe, out=recipe.parent / "data", shard_samples=4, **COUNTS)


def kinds(dataset, split):
    samples = dataset.split(split)
    return [samples.home(n).graded for n in range(len(samples))]


def test_samples_come_by_weight_and_know_their_kind(mixed):
    assert mixed.manifest.kind == manifest.SEVERAL
    assert kinds(mixed, "train") == ["pillar"] * 12 + ["clutter"] * 4 + ["maze-hard"] * 4
    assert kinds(mixed, "val") == ["pillar"] * 3 + ["clutter", "maze-hard"]
    names = mixed.split("train").names
    assert len(set(names)) == len(names) == 20
    assert mixed.split("train").count_worlds() == 10


def test_a_component_has_the_samples_that_it_has_by_itself(mixed, recipe):
    (pillars, _), *_ = read_components(recipe)
    counts = {"train": 12, "val": 3, "test": 3}
    alone = built(plan_of(recipe.parent / "alone", pillars, seed=4, counts=counts))
    for split, count in counts.items():
        ours, theirs = ([one.sha256() for one in its.split(split)] for its in (mixed, alone))
        assert ours[:count] == theirs


def test_what_is_lost_is_made_again_by_any_number_of_workers(mixed, recipe):
    before = manifest.read(mixed.folder)
    for name in ("train-00003.h5", "val-00001.worlds.zip", "test-00002.h5"):
        (mixed.folder / name).unlink()
    again = scenegen.generate(recipe=recipe, out=mixed.folder, workers=2, shard_samples=4, **COUNTS)
    assert manifest.read(again.folder) == before


def test_another_recipe_is_refused_by_the_parameter_that_differs(mixed, tmp_path):
    other = tmp_path / "r.toml"
    other.write_text(RECIPE.replace("0.06]", "0.07]"))
    named = r"sources\.0\.parameters\.recipe\.world\.density is \[0\.06, 0\.06\] there"
    with pytest.raises(DatasetError, match=named):
        scenegen.generate(recipe=other, out=mixed.folder, shard_samples=4, **COUNTS)


def test_it_is_verified_inspected_measured_and_gathered(mixed, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("scenegen.model.evaluation.shown._webp", lambda figure: b"")
    folder = mixed.folder
    done(capsys, f"verify {folder} --kind clutter")
    named = trust.parse(manifest.read(folder), folder, "clutter")
    assert {home.named for home in named.homes} == {"clutter"}
    assert "clutter, seed 4, train 4, val 1, test 1" in done(capsys, f"inspect {folder} --details")
    done(capsys, f"bench {folder} --method returns --quick --quiet -o {tmp_path}/b")
    report = (tmp_path / "b" / "report.md").read_text()
    assert {"pillar", "clutter", "maze-hard"} <= {*re.findall(r"^## (.*)$", report, re.M)}
    take = f"take {folder} --quiet -o {tmp_path}/two --kind"
    done(capsys, f"{take} maze-hard --kind clutter")
    assert kinds(Dataset(tmp_path / "two"), "train") == ["clutter"] * 4 + ["maze-hard"] * 4
    assert "no sample is as asked for (--kind cave)" in refused(capsys, f"{take} cave --force")


@pytest.mark.parametrize(("weights", "n"), [((1, 1, 1), 23), ((0.5, 7, 2.25), 2500)])
def test_the_recipe_that_a_manifest_spells_out_plans_the_same(tmp_path, weights, n):
    text = DIFFERENT
    for old, new in zip(("weight = 3", "weight = 2", "weight = 1"), weights, strict=True):
        text = text.replace(old, f"weight = {new}")
    (tmp_path / "r.toml").write_text(text)
    asked = {"n": n, "seed": 4, "out": "x", "shard_samples": 400}
    plan = plan_generation(recipe=tmp_path / "r.toml", **asked)
    (tmp_path / "again.toml").write_text(recipe_text(plan.parameters, "again"))
    write_rays(plan.lidars, tmp_path)
    again = plan_generation(recipe=tmp_path / "again.toml", **asked)
    assert again.parameters == plan.parameters


@pytest.mark.usefixtures("undrawn")
def test_one_dataset_holds_several_sensors_noises_and_scan_counts(tmp_path, capsys):
    (tmp_path / "r.toml").write_text(DIFFERENT)
    scenegen.generate(recipe=tmp_path / "r.toml", out=tmp_path / "a", workers=1, n=6, val=0, test=0)
    found = Dataset(tmp_path / "a", checked=True)
    assert found.manifest.parameters["version"] == "1.6"
    assert sorted(found.manifest.parameters["differ"]) == ["fields", "lidar", "mapping", "noise"]
    tables = {path.name for path in found.folder.glob("rays*.npy")}
    assert len(tables) == 2
    assert tables < found.manifest.files.keys()
    samples = found.split("train")
    for n, sample in enumerate(samples):
        home = samples.home(n)
        assert (sample.lidar, sample.ranges.shape) == (home.lidar, home.lidar.shape)
        assert (sample.earlier_ranges is not None) == (home.mapping.scans == 2)
        fused = fuse(sample.scans()[::-1], sample.grid, sample.origin, home.mapping)
        assert np.array_equal(sample.free, fused.free)
    maps = Maps([SplitSamples(found, "train")], "train", ("observed", "distance"))
    assert {len(maps[n]) for n in range(len(maps))} == {4}  # two inputs, occupancy and distances
    assert len(set(maps.settings)) == 3
    assert verify(found.folder).ok
    said = done(capsys, f"inspect {found.folder} --details")
    assert ("velodyne-vlp-16" in said, "dropout" in said) == (True, True)
    request = Request(dataset=found.folder, repository="ada/mixed", out=tmp_path / "p")
    stage(request, checks=(("splits", "apart"),))
    assert "load_dataset" not in (request.out / "README.md").read_text()
    few, rest = (
        built(plan_take(found, tmp_path / kinds[0], Choice(kinds=kinds)))
        for kinds in (("maze-hard",), ("pillar", "clutter"))
    )
    assert few.manifest.parameters.get("differ") is None
    assert [path.name for path in few.folder.glob("rays*.npy")] == ["rays.npy"]
    again = built(plan_merge([rest, few], tmp_path / "again")).split("train")
    assert {one.sha256() for one in again} == {one.sha256() for one in samples}


def test_without_components_every_kind_has_the_same_weight():
    n = len(kind_names())
    every = plan_generation("mixed", 100, val=0, test=0, out="x", labels="class")
    assert sum(shard.samples for shard in every.shards) == 100
    assert {shard.samples for shard in every.shards} <= {100 // n, 100 // n + 1}
    assert len(every.shards) == n
    stream = scenegen.stream("mixed")
    assert {stream.part(at)[0] for at in range(5 * n)} == set(range(n))


BAD = """
weight = 3             →                  → component 1 ('pillar'): has no weight, and others have
weight = 3             → weight = -1      → weight of 'pillar' = -1: expected a number above 0
kind = "clutter"       →                  → component 2: names no kind
density = [0.06, 0.06] → density = [2, 1] → [world] density = [2, 1]
[grid]                 → domain.lidar.rows = 4; [grid]                 → a list of values
[grid]                 → domain.lidar.rows = "2..4"; [grid]            → domain.draws
[grid]                 → domain.draws = 2; [grid]                      → domain.draws
[grid]                 → domain = {draws = 1000000000, lidar.rows = "2..4"}; [grid] → combinations
[grid]                 → domain.rows = [4]; [grid]                     → tables of lists
[component.world]      → [component.grid]; voxel_m = 1; [component.world]           → grid.voxel
weight = 3             → weight = 3; lidar.rows = 3; [domain.lidar]; rows = [4]     → and a domain
"""


@pytest.mark.parametrize(("old", "new", "told"), rows(BAD))
def test_a_bad_mixture_ends_in_one_line(tmp_path, old, new, told):
    (tmp_path / "r.toml").write_text(RECIPE.replace(old, new.replace("; ", "\n"), 1))
    with pytest.raises(RecipeError, match=re.escape(told)):
        plan_generation(recipe=tmp_path / "r.toml", out=tmp_path / "d", **COUNTS)


@pytest.mark.parametrize("given", [{"noise": ""}, {"difficulty": "easy"}])
def test_what_a_component_has_is_not_replaced_by_what_is_given_for_all(tmp_path, given):
    (tmp_path / "r.toml").write_text(DIFFERENT)
    with pytest.raises(RecipeError, match=r"component \d: has .* is given beside it"):
        read_components(tmp_path / "r.toml", **given)


DOMAIN = """
[domain.lidar]
rows = [2, 3]
[domain.mapping]
scans = [1, 2]
[domain.noise]
stages = ["", "dropout:0.5"]
"""


def test_a_domain_draws_with_every_combination_of_what_it_lists(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(RECIPE.replace("[[component]]", DOMAIN + "[[component]]", 1))
    components = read_components(path)
    weights = [weight for _, weight in components]
    assert [sum(weights[n : n + 8]) for n in range(0, len(weights), 8)] == [3, 1, 1]
    beside = scenegen.stream({str(path): 1, components[0][0]: 3})
    assert [beside.part(n)[0] for n in range(800)].count(24) == 600
    stream, returned = scenegen.stream(str(path), samples=80), {}
    for n, sample in enumerate(stream):
        lidar, mapping, noise = stream.settings[stream.part(n)[0]]
        assert (sample.lidar, sample.ranges.shape) == (lidar, lidar.shape)
        assert (sample.earlier_ranges is not None) == (mapping.scans == 2)
        seen = returned.setdefault((lidar.rows, mapping.scans, noise), [])
        seen.append(np.isfinite(sample.ranges).mean())
    assert len(returned) == 8
    whole, dropped = (
        sum(sum(seen) for (_, _, noise), seen in returned.items() if bool(noise) == noisy)
        for noisy in (False, True)
    )
    assert dropped < 0.8 * whole


def test_a_domain_of_one_kind_needs_no_component(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text('kind = "pillar"\n[domain.flight]\naltitude_m = [[0.5, 1.0], [2.0, 4.0]]\n')
    samples = scenegen.generate(recipe=path, out=tmp_path / "d", n=20, val=0, test=0).split("train")
    heights = [sample.position[2] for sample in samples]
    assert sum(height <= 1.0 for height in heights) == 10
    assert sum(2.0 <= height <= 4.0 for height in heights) == 10
    stream = scenegen.stream(str(path), samples=20)
    drawn, stored = ({one.ranges.tobytes() for one in them} for them in (stream, samples))
    assert drawn == stored


INTERVALS = """
kind = "pillar"
[domain]
draws = 4
[domain.lidar]
rows = ["2..9", 20]
[domain.noise]
stages = "range:0.01..0.05,dropout:0.5"
[domain.flight]
altitude_m = [["0.5..1.0", "3.0..2.0"]]
"""
BOUNDS = (2, 9), (0.01, 0.05), (0.5, 1.0), (2.0, 3.0)


def test_a_domain_draws_numbers_from_intervals_and_samples_know_them(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(INTERVALS)
    drawn, again, other = ([one for one, _ in read_components(path, seed=n)] for n in (3, 3, 4))
    assert drawn == again != other
    rows = [(o.lidar.rows, o.noise.stages[0].sigma_m, *o.flight.altitude_m) for o in drawn[::2]]
    for numbers, (low, high) in zip(np.transpose(rows), BOUNDS, strict=True):
        assert low <= min(numbers) < max(numbers) <= high
    settings = scenegen.stream(str(path), seed=3).settings
    assert [noise for _, _, noise in settings] == [one.noise.spelled() for one in drawn]
