"""Datasets with noise: ranges alone differ, and a stranger's word on it is not trusted."""

import dataclasses
import shutil

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import BeamTable, Lidar
from lidarsim.noise import VERSION
from lidarsim.noise.chain import Noise
from scenegen.base.errors import RecipeError
from scenegen.dataset.parameters import recipe_text
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NAME, NoiseEntry
from scenegen.verification import verify
from scenegen.worlds.recipe import preset, read_recipe
from tests.conftest import COUNTS, dataset_in, small_recipe
from tests.scenegen import cases, refuses
from tests.scenegen.conftest import drawn_unit
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

CHAIN = "range:0.02,dropout:0.05"
SPELLED = "range:sigma_m=0.02:share=0.0:quadratic_per_m=0.0,dropout:share=0.05"


def made_with(folder, noise):
    """The dataset of `made`, with noise."""
    recipe = small_recipe(noise={"stages": noise})
    return dataset_in(folder, recipe, seed=3, counts=COUNTS, shard_samples=5)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """The dataset of `made`, with noise, in other shards; not to be changed."""
    return made_with(tmp_path_factory.mktemp("noisy") / "pillar", CHAIN).folder


def test_noise_changes_ranges_alone(made, noisy):
    stated = NoiseEntry(stages=SPELLED, bound_m=4 * 0.02, version=VERSION)
    assert [Dataset(folder).manifest.noise for folder in (made, noisy)] == [None, stated]
    both = (Dataset(folder).split("train") for folder in (made, noisy))
    for one, other in zip(*both, strict=True):
        for name in ("occupancy", "tudf", "position", "quaternion", "origin", "world", "viewpoint"):
            assert_array_equal(getattr(one, name), getattr(other, name))
        kept = np.isfinite(other.ranges)
        assert (kept <= np.isfinite(one.ranges)).all()
        assert 0 < np.abs(one.ranges[kept] - other.ranges[kept]).max() <= 0.08 + 1e-6


def noted(folder, *, signed=True, **changes):
    """The folder, whose manifest states other noise."""
    tables = forge.read(folder)["recipe"]
    entry = {"stages": SPELLED, "bound_m": 0.08, "version": VERSION} | changes
    change = forge.sign if signed else forge.edit_manifest
    change(folder, recipe=tables | {"noise": entry})
    return folder


@pytest.fixture
def folder(noisy, tmp_path):
    """A copy, to change."""
    return forge.copy(noisy, tmp_path / "d")


def test_noise_of_an_older_version_is_read_and_its_difference_reported(folder):
    """Other numbers are then `differs` and no fault. Here the stages differ, for numbers of that
    version are gone."""
    noted(folder, stages=SPELLED.replace("0.02", "0.019"), bound_m=0.076, version=1)
    checks = {check.name: check for check in verify(folder).checks}
    assert [name for name, check in checks.items() if not check.ok] == []
    assert checks["rays"].differing


WEAKER = SPELLED.replace("0.02", "0.01")


@pytest.mark.parametrize(
    ("changes", "check", "quick"),
    [
        ({"stages": WEAKER, "bound_m": 0.04}, "rays", False),
        ({"stages": "dropout:share=0.05", "bound_m": 0.0}, "laws", True),
        ({"bound_m": 0.5}, "manifest", True),
    ],
)
def test_what_the_noise_cannot_have_done_is_found(folder, changes, check, quick):
    assert check in failed(noted(folder, signed=False, **changes), quick=quick)


def test_ranges_with_noise_do_not_pass_as_clean(folder):
    forge.edit_at(folder, "recipe.noise", "null")
    assert "laws" in failed(folder, quick=True)


@pytest.mark.parametrize(("path", "value", "told"), cases("dataset/noise"))
def test_a_strangers_word_is_not_trusted(noisy, tmp_path, path, value, told):
    shutil.copy(noisy / NAME, tmp_path)
    refuses(told, lambda: Dataset(forge.edit_at(tmp_path, path, value)))


def test_no_reader_imports_a_stage_that_a_manifest_names(folder, trap):
    noted(folder, stages="range,trap:Stage:3")
    assert Dataset(folder).split("train")[0].free.any()
    skipped = {check.name for check in verify(folder).checks if check.skipped}
    assert {"rays", "regenerated"} <= skipped


FAR = """from lidarsim.noise.losses import Dropout
class Far(Dropout):
    def apply(self, returns, view, *, rng): return returns.but(ranges=returns.ranges * 3)
"""


@pytest.mark.parametrize(
    ("noise", "told"),
    [
        ("divergence:3:returns=dual", "a dataset holds one range a ray"),
        ("intensity", "a dataset holds one range a ray"),
        ("far_noise:Far", "noise stage far_noise:Far gave"),
    ],
)
def test_what_ranges_cannot_hold_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, noise, told
):
    (tmp_path / "far_noise.py").write_text(FAR)
    monkeypatch.syspath_prepend(str(tmp_path))
    refuses(told, made_with, tmp_path / "data", noise)
    assert not (tmp_path / "data").exists()


def test_corrected_motion_is_refused_and_motion_that_bends_walls_is_not():
    rays = BeamTable.of(Lidar(rows=4, columns=30)).rays.copy()
    rays[..., 3] = np.linspace(0.0, 0.1, 30)

    def drawn(noise):
        recipe = dataclasses.replace(
            small_recipe(), lidar=BeamTable(rays=rays), noise=Noise.parse(noise)
        )
        return drawn_unit(recipe, seed=1).samples[0]

    assert (drawn("dropout:0").ranges != drawn("motion:5").ranges).mean() > 0.3
    refuses("rays begin where the scan does", drawn, "motion:5:corrected=true")


def test_a_recipe_file_says_its_noise_and_is_held_to_it(noisy, tmp_path):
    file, manifest = tmp_path / "it.toml", Dataset(noisy).manifest
    file.write_text(recipe_text(manifest.tables, "it"))
    assert read_recipe(file) == manifest.recipe
    assert manifest.recipe.noise == Noise.parse(CHAIN)
    refuses(r"has a table \[noise\], and --noise", read_recipe, file, noise="near")


@pytest.mark.parametrize("stages", ["rnage:0.02", "datasheet", "none,none", "range,none"])
def test_noise_that_is_not_to_be_had_is_refused(stages):
    with pytest.raises(RecipeError):
        preset("pillar", noise=stages)


def test_none_by_itself_stands_for_clean_ranges():
    assert preset("pillar", noise="none") == preset("pillar")
