"""Collections: datasets read as one, those of a mixture first; shares, resuming, and what is wrong
in one line."""

import re
import shutil

import numpy as np
import pytest

import scenegen
from lidarsim import fuse
from scenegen import SPLITS
from scenegen.base.errors import DatasetError
from scenegen.dataset.build import plan_dataset
from scenegen.dataset.collection import COLLECTION, open_data
from scenegen.dataset.generation import plan_generation, read_components
from scenegen.draw.source import read_scenes
from scenegen.verification import verify
from scenegen.worlds.kinds import kind_names
from tests.conftest import contents, dataset_in, plan_of, scene_recipe, small_recipe
from tests.scenegen import cases, refuses
from tests.scenegen.conftest import built
from tests.scenegen.dataset import NASTY, SCENE, put, samples_of

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


@pytest.fixture
def changed(mixed, tmp_path):
    """A copy, to change."""
    return shutil.copytree(mixed.name, tmp_path / "mixed")


def kinds(dataset, split):
    samples = dataset.split(split)
    return [samples.home(n).graded for n in range(len(samples))]


def test_samples_come_by_weight_and_know_their_kind(mixed):
    assert kinds(mixed, "train") == ["pillar"] * 12 + ["clutter"] * 4 + ["maze-hard"] * 4
    assert kinds(mixed, "val") == ["pillar"] * 3 + ["clutter", "maze-hard"]
    assert {kind: len(own) for kind, own in mixed.split("test").by_kind().items()} == {
        **{"pillar": 3, "clutter": 1, "maze-hard": 1}
    }


def test_worlds_of_a_collection_have_numbers_of_their_own(mixed):
    samples = mixed.split("train")
    assert len(set(samples.names)) == len(samples) == 20
    assert samples.count_worlds() == 10
    for n, sample in enumerate(samples):
        assert samples.names[n] == ("train", sample.world, sample.viewpoint)
    first = mixed.datasets[2].world("train", 0)
    assert mixed.world("train", samples[16].world) == first
    with pytest.raises(DatasetError):
        mixed.world("train", 10)


def test_a_component_has_the_samples_that_it_has_by_itself(mixed, recipe):
    (pillars, _), *_ = read_components(recipe)
    counts = {"train": 12, "val": 3, "test": 3}
    alone = built(plan_of(recipe.parent / "alone", pillars, seed=4, counts=counts))
    for split, count in counts.items():
        assert samples_of(mixed, split)[:count] == samples_of(alone, split)


def test_a_collection_has_the_samples_of_its_datasets(mixed):
    for split in SPLITS:
        expected = [one for dataset in mixed.datasets for one in samples_of(dataset, split)]
        assert samples_of(mixed, split) == expected


@pytest.mark.parametrize("how", ["list", "folder"])
def test_datasets_are_read_together_without_a_file_that_lists_them(mixed, changed, how):
    (changed / COLLECTION).unlink()
    names = changed if how == "folder" else [changed / one.folder.name for one in mixed.datasets]
    for split in SPLITS:
        assert sorted(samples_of(open_data(names), split)) == sorted(samples_of(mixed, split))


def test_what_is_lost_is_made_again_by_any_number_of_workers(mixed, changed, recipe):
    before = contents(changed)
    for name in ("pillar/train-00002.h5", "clutter/val-00000.worlds.zip", COLLECTION):
        (changed / name).unlink()
    scenegen.generate(recipe=recipe, out=changed, workers=2, shard_samples=4, **COUNTS)
    assert contents(changed) == before


def test_another_collection_is_replaced_where_force_is_given(changed, recipe, tmp_path):
    other, counts = tmp_path / "r.toml", {"n": 2, "val": 0, "test": 0}
    other.write_text(f'{SMALL}[[component]]\nkind = "rooms"\n[[component]]\nkind = "maze"\n')
    before = contents(changed)
    refuses("another collection", scenegen.generate, recipe=other, out=changed, **counts)
    assert contents(changed) == before
    replaced = scenegen.generate(recipe=other, out=changed, force=True, **counts)
    assert kinds(replaced, "train") == ["rooms", "maze"]


def test_a_folder_with_other_files_does_not_become_a_collection(recipe, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    for force in (False, True):
        refuses(
            "holds other files",
            scenegen.generate,
            recipe=recipe,
            out=tmp_path,
            force=force,
            **COUNTS,
        )
    assert contents(tmp_path) == {"thesis.tex": b"years of work"}


@pytest.mark.parametrize("path", ["format", "version", "datasets", "datasets.0", "odd"])
def test_no_value_in_a_collections_list_ends_in_a_traceback(changed, path):
    for value in NASTY:
        shutil.copy(changed / COLLECTION, changed / "kept")
        put(changed / COLLECTION, path, value)
        with pytest.raises(DatasetError):
            open_data(changed)
        shutil.move(changed / "kept", changed / COLLECTION)


def test_datasets_of_other_grids_are_not_read_together(mixed, tmp_path):
    other = dataset_in(tmp_path / "d", small_recipe(grid={"shape": (16, 16, 16)}))
    refuses("its grid is", open_data, [mixed, other])


def test_a_dataset_is_not_read_together_with_itself(tmp_path):
    one = dataset_in(tmp_path / "one")
    more = dataset_in(tmp_path / "more", counts={"train": 6, "val": 0, "test": 0}, compact=True)
    other = dataset_in(tmp_path / "other", seed=1)
    assert len(open_data([one, other]).split("train")) == 6
    for again in (one.folder, more.folder):
        refuses("holds the same samples", open_data, [one, again])


def test_no_world_from_a_file_is_in_two_splits(tmp_path):
    (tmp_path / "a.xml").write_text(SCENE.format(x=4))
    (tmp_path / "b.xml").write_text(SCENE.format(x=5))

    def dataset_of(name, split):
        counts = dict.fromkeys(SPLITS, 0) | {split: 3}
        source = read_scenes(tmp_path / name, counts, seed=0)
        plan = plan_dataset(
            tmp_path / f"{name}-{split}", scene_recipe(), source, seed=0, counts=counts
        )
        return built(plan)

    trained = dataset_of("a.xml", "train")
    assert len(open_data([trained, dataset_of("b.xml", "test")]).split("test")) == 3
    refuses("two splits", lambda: open_data([trained, dataset_of("a.xml", "test")]))


@pytest.fixture(scope="module")
def different(tmp_path_factory):
    folder = tmp_path_factory.mktemp("different")
    (folder / "r.toml").write_text(DIFFERENT)
    return scenegen.generate(recipe=folder / "r.toml", out=folder / "a", n=6, val=0, test=0)


def test_datasets_of_other_sensors_noises_and_scan_counts_go_together(different):
    assert verify(different.name).ok
    samples = different.split("train")
    for n, sample in enumerate(samples):
        home = samples.home(n)
        assert (sample.lidar, sample.ranges.shape) == (home.lidar, home.lidar.shape)
        assert (sample.earlier_ranges is not None) == (home.mapping.scans == 2)
        fused = fuse(sample.scans()[::-1], sample.grid, sample.origin, home.mapping)
        assert np.array_equal(sample.free, fused.free)


def test_without_components_every_kind_has_the_same_weight():
    plans = plan_generation("mixed", 100, val=0, test=0, out="x", labels="class").datasets
    n = len(kind_names())
    assert [plan.folder.name for plan in plans] == list(kind_names())
    assert sum(plan.samples for plan in plans) == 100
    assert {plan.samples for plan in plans} <= {100 // n, 100 // n + 1}


def test_components_of_one_kind_are_numbered_and_draw_other_worlds(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(SMALL + 2 * '[[component]]\nkind = "pillar"\n')
    found = scenegen.generate(recipe=path, out=tmp_path / "d", n=8, val=0, test=0)
    assert [one.folder.name for one in found.datasets] == ["pillar-000", "pillar-001"]
    assert len({sample.ranges.tobytes() for sample in found.split("train")}) == 8


@pytest.mark.parametrize(("old", "new", "told"), cases("dataset/collection"))
def test_a_bad_mixture_ends_in_one_line(tmp_path, old, new, told):
    (tmp_path / "r.toml").write_text(RECIPE.replace(old, new.replace("; ", "\n"), 1))
    refuses(
        re.escape(told), plan_generation, recipe=tmp_path / "r.toml", out=tmp_path / "d", **COUNTS
    )


@pytest.mark.parametrize("given", [{"noise": ""}, {"difficulty": "easy"}])
def test_what_a_component_has_is_not_replaced_by_what_is_given_for_all(tmp_path, given):
    (tmp_path / "r.toml").write_text(DIFFERENT)
    refuses(
        r"component \d: has .* is given beside it", read_components, tmp_path / "r.toml", **given
    )


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
