"""Collections: datasets read as one, those of a mixture first; shares, resuming, and what is wrong
in one line."""

import itertools
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import scenegen
from lidarsim import fuse
from lidarsim.noise.chain import Noise
from scenegen import SPLITS
from scenegen.base.errors import DatasetError
from scenegen.dataset.build import plan_dataset
from scenegen.dataset.collection import COLLECTION, open_data
from scenegen.dataset.generation import plan_generation, read_components
from scenegen.draw.source import read_scenes
from scenegen.verification import verify
from scenegen.worlds.kinds import training_kinds
from tests.command_line import beside
from tests.conftest import contents, dataset_in, scene_recipe, small_recipe
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.conftest import built
from tests.scenegen.dataset import NASTY, SCENE, put, samples_of

RECIPE = beside(__file__, "mixed.toml")
SMALL = RECIPE.partition("[[component]]")[0]
COUNTS = {"n": 20, "val": 5, "test": 5, "seed": 4}
DIFFERENT = beside(__file__, "different.toml")
"""Components that differ in sensor, noise and scans."""


TRAIN = {"val": 0, "test": 0}


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "recipe.toml"
    path.write_text(RECIPE)
    return path


@pytest.fixture(scope="session")
def mixed(once):
    def make(folder):
        (folder / "r.toml").write_text(RECIPE)
        scenegen.generate(recipe=folder / "r.toml", out=folder / "d", shard_samples=4, **COUNTS)

    return open_data(once("mixed", make) / "d")


@pytest.fixture
def changed(mixed, tmp_path):
    """A copy, to change."""
    return shutil.copytree(mixed.name, tmp_path / "mixed")


def kinds(dataset, split):
    samples = dataset.split(split)
    return [samples.home(n).graded for n in range(len(samples))]


def test_samples_come_by_weight_and_know_their_kind(mixed):
    assert kinds(mixed, "train") == ["pillar"] * 12 + ["clutter"] * 4 + ["maze-hard"] * 4
    by_kind = mixed.split("test").by_kind().items()
    expected = [("pillar", 3), ("clutter", 1), ("maze-hard", 1)]
    assert [(kind, len(samples)) for kind, samples in by_kind] == expected


def test_worlds_of_a_collection_have_numbers_of_their_own(mixed):
    samples = mixed.split("train")
    names = [("train", sample.world, sample.viewpoint) for sample in samples]
    assert samples.names == names
    assert (len(set(names)), samples.count_worlds()) == (20, 10)
    first = mixed.datasets[2].world("train", 0)
    assert mixed.world("train", samples[16].world) == first
    with pytest.raises(DatasetError):
        mixed.world("train", 10)


def test_a_component_has_the_samples_that_it_has_by_itself(mixed, recipe, tmp_path):
    (pillars, _), *_ = read_components(recipe)
    counts = {"train": 12, "val": 3, "test": 3}
    alone = dataset_in(tmp_path / "alone", pillars, seed=4, counts=counts)
    first, *others = mixed.datasets
    assert alone.digest == first.digest
    for split in SPLITS:
        members = (samples_of(dataset, split) for dataset in (alone, *others))
        assert samples_of(mixed, split) == list(itertools.chain(*members))


def test_what_is_lost_is_made_again_by_any_number_of_workers(mixed, changed, recipe):
    for name in ("pillar/train-00002.h5", "clutter/val-00000.worlds.zip", COLLECTION):
        (changed / name).unlink()
    scenegen.generate(recipe=recipe, out=changed, workers=2, shard_samples=4, **COUNTS)
    assert contents(changed) == contents(Path(mixed.name))


def test_another_collection_is_replaced_where_force_is_given(changed, mixed, recipe):
    recipe.write_text(f'{SMALL}[[component]]\nkind = "rooms"\n[[component]]\nkind = "maze"\n')
    generate = partial(scenegen.generate, recipe=recipe, out=changed, n=2, **TRAIN)
    refuses("without force", generate)
    assert contents(changed) == contents(Path(mixed.name))
    assert kinds(generate(force=True), "train") == ["rooms", "maze"]


def test_a_folder_with_other_files_does_not_become_a_collection(recipe, tmp_path):
    """Even by force; without it, test_strangers shows."""
    (out := tmp_path / "mine").mkdir()
    (out / "thesis.tex").write_text("years of work")
    refuses("thesis", scenegen.generate, recipe=recipe, out=out, force=True, **COUNTS)
    assert contents(out) == {"thesis.tex": b"years of work"}


@pytest.mark.parametrize("path", ["format", "version", "datasets", "datasets.0", "odd"])
def test_no_value_in_a_collections_list_ends_in_a_traceback(changed, path):
    original = (changed / COLLECTION).read_bytes()
    for value in NASTY:
        (changed / COLLECTION).write_bytes(original)
        put(changed / COLLECTION, path, value)
        with pytest.raises(DatasetError):
            open_data(changed)


def test_datasets_that_do_not_go_together_are_refused(tmp_path):
    def make(name, **options):
        return dataset_in(tmp_path / name, **options).folder

    folder, other_grid = make("d"), small_recipe(grid={"shape": (16, 16, 16)})
    refuses("d", open_data, [folder, folder])
    refuses("longer", open_data, [folder, make("longer", counts={**TRAIN, "train": 6})])
    refuses("other grid", open_data, [folder, make("other grid", recipe=other_grid)])
    assert len(open_data([folder, make("other seed", seed=1)]).split("train")) == 6


def test_no_world_from_a_file_is_in_two_splits(tmp_path):
    def dataset_of(x, split):
        scene, counts = tmp_path / f"{x}-{split}.xml", dict.fromkeys(SPLITS, 0) | {split: 3}
        scene.write_text(SCENE.format(x=x))
        source = read_scenes(scene, counts, seed=0)
        plan = plan_dataset(scene.with_suffix(""), scene_recipe(), source, seed=0, counts=counts)
        return built(plan)

    trained = dataset_of(4, "train")
    assert len(open_data([trained, dataset_of(5, "test")]).split("test")) == 3
    refuses("two", open_data, [trained, dataset_of(4, "test")])


def test_datasets_of_other_sensors_noises_and_scan_counts_go_together(recipe, tmp_path):
    recipe.write_text(DIFFERENT)
    different = scenegen.generate(recipe=recipe, out=tmp_path / "d", n=6, **TRAIN)
    assert verify(different.name).ok
    samples = different.split("train")
    for n, sample in enumerate(samples):
        home = samples.home(n)
        assert (sample.lidar, sample.ranges.shape) == (home.lidar, home.lidar.shape)
        assert len(sample.scans()) == home.mapping.scans
        fused = fuse(sample.scans()[::-1], sample.grid, sample.origin, home.mapping)
        assert np.array_equal(sample.free, fused.free)


def test_without_components_every_kind_has_the_same_weight():
    plans = plan_generation("mixed", 100, val=0, test=0, out="x", labels="class").datasets
    shares = {plan.folder.name: plan.samples for plan in plans}
    assert shares == dict.fromkeys(training_kinds(), 100 / len(plans))


def test_components_of_one_kind_are_numbered_and_draw_other_worlds(recipe, tmp_path):
    recipe.write_text(SMALL + 2 * '[[component]]\nkind = "pillar"\n')
    pillars = scenegen.generate(recipe=recipe, out=tmp_path / "d", n=8, **TRAIN)
    assert [dataset.folder.name for dataset in pillars.datasets] == ["pillar-000", "pillar-001"]
    assert len({sample.ranges.tobytes() for sample in pillars.split("train")}) == 8


@each_case("dataset/collection", "old new")
def test_a_bad_mixture_ends_in_one_line(recipe, tmp_path, old, new):
    recipe.write_text(RECIPE.replace(old, new.replace("; ", "\n"), 1))
    refuses(f"{old} {new}", plan_generation, recipe=recipe, out=tmp_path / "d", **COUNTS)


@pytest.mark.parametrize(("name", "value"), [("noise", ""), ("difficulty", "easy")])
def test_what_a_component_has_is_not_replaced_by_what_is_given_for_all(recipe, name, value):
    recipe.write_text(DIFFERENT)
    refuses(name, read_components, recipe, **{name: value})


DOMAIN = """
[domain.lidar]
rows = [2, 3]
[domain.mapping]
scans = [1, 2]
[domain.noise]
stages = ["", "dropout:0.5"]
"""


def test_a_domain_draws_with_every_combination_of_what_it_lists(recipe):
    recipe.write_text(RECIPE.replace("[[component]]", DOMAIN + "[[component]]", 1))
    parts, weights = zip(*read_components(recipe), strict=True)
    assert np.reshape(weights, (3, 8)).sum(axis=1).tolist() == [3, 1, 1]
    beside = scenegen.stream({str(recipe): 1, parts[0]: 3})
    assert [beside.part(n)[0] for n in range(800)].count(24) == 600
    settings = {(part.lidar.rows, part.mapping.scans, part.noise) for part in parts[:8]}
    assert settings == set(itertools.product((2, 3), (1, 2), (Noise(), Noise.parse("dropout:0.5"))))


BOUNDS = (2, 9), (0.01, 0.05), (0.5, 1.0), (2.0, 3.0)


def test_a_domain_draws_numbers_from_intervals_and_samples_know_them(recipe):
    recipe.write_text(beside(__file__, "intervals.toml"))
    drawn, again, reseeded = (
        [part for part, _ in read_components(recipe, seed=n)] for n in (3, 3, 4)
    )
    assert drawn == again != reseeded
    rows = [(it.lidar.rows, it.noise.stages[0].sigma_m, *it.flight.altitude_m) for it in drawn[::2]]
    lowest, highest = zip(*BOUNDS, strict=True)
    assert ((lowest <= np.min(rows, axis=0)) & (np.max(rows, axis=0) <= highest)).all()
    assert np.ptp(rows, axis=0).all()
    settings = scenegen.stream(str(recipe), seed=3).settings
    assert [noise for _, _, noise in settings] == [part.noise.spelled() for part in drawn]
