"""Datasets with noise, of several scans a sample, of leaning bodies, and of maps that lie ahead:
pairs of the same worlds."""

import dataclasses
import json

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import BeamTable, Lidar, Pose
from lidarsim.noise import VERSION
from lidarsim.noise.chain import Noise
from scenegen.dataset.parameters import recipe_text
from scenegen.dataset.read import Dataset
from scenegen.dataset.schema import NoiseEntry
from scenegen.verification import verify
from scenegen.worlds.mapping import Mapper
from scenegen.worlds.recipe import make_recipe, preset, read_recipe
from tests.command_line import done
from tests.conftest import dataset_in, small_recipe
from tests.refusals import refuses, refuses_command
from tests.scenegen import each_case
from tests.scenegen.conftest import drawn_unit
from tests.scenegen.dataset import of_poses
from tests.scenegen.dataset.conftest import NOISE, SEVERAL, made_with
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

SPELLED = "range:sigma_m=0.02:share=0.0:quadratic_per_m=0.0,dropout:share=0.05"


def test_noise_changes_ranges_alone(made, noisy):
    stated = NoiseEntry(stages=SPELLED, bound_m=4 * 0.02, version=VERSION)
    clean = Dataset(made)
    assert (clean.manifest.noise, noisy.manifest.noise) == (None, stated)
    originals, samples = clean.split("train"), noisy.split("train")
    assert of_poses(originals) == of_poses(samples)
    for original, sample in zip(originals, samples, strict=True):
        returned = np.isfinite(sample.ranges)
        assert (returned <= np.isfinite(original.ranges)).all()
        assert 0 < np.abs(original.ranges[returned] - sample.ranges[returned]).max() <= 0.08 + 1e-6


@pytest.fixture
def folder(noisy, tmp_path):
    """A copy, to change."""
    return forge.copy(noisy.folder, tmp_path / "d")


def test_noise_of_an_older_version_is_read_and_its_difference_reported(folder):
    """Other numbers are then `differs` and no fault. Here the stages differ, for numbers of that
    version are gone."""
    older = {"stages": SPELLED.replace("0.02", "0.019"), "bound_m": 0.076, "version": 1}
    forge.sign(forge.edit_at(folder, "recipe.noise", json.dumps(older)))
    report = verify(folder)
    assert report.ok, report.failed
    assert "rays" in report.differing


@each_case("dataset/noise_changed", "path value check")
def test_what_the_noise_cannot_have_done_is_found(folder, path, value, check):
    assert check in failed(forge.edit_at(folder, path, value), quick=check != "rays")


def test_no_reader_imports_a_stage_that_a_manifest_names(folder, trap):
    forge.sign(forge.edit_at(folder, "recipe.noise.stages", '"range,trap:Stage:3"'))
    assert Dataset(folder).split("train")[0].free.any()
    skipped = {check.name for check in verify(folder).checks if check.skipped}
    assert {"rays", "regenerated"} <= skipped


FAR = """from lidarsim.noise.losses import Dropout
class Far(Dropout):
    def apply(self, returns, view, *, rng): return returns.but(ranges=returns.ranges * 3)
"""


@pytest.mark.parametrize("noise", ["divergence:3:returns=dual", "intensity", "far_noise:Far"])
def test_what_ranges_cannot_hold_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, noise
):
    (tmp_path / "far_noise.py").write_text(FAR)
    monkeypatch.syspath_prepend(str(tmp_path))
    refuses(noise, made_with, tmp_path / "data", noise={"stages": noise})
    assert not (tmp_path / "data").exists()


def test_corrected_motion_is_refused_and_motion_that_bends_walls_is_not():
    rays = BeamTable.of(Lidar(rows=4, columns=30)).rays.copy()
    rays[..., 3] = np.linspace(0.0, 0.1, 30)
    recipe = dataclasses.replace(small_recipe(), lidar=BeamTable(rays=rays))

    def ranges(noise):
        noisy = dataclasses.replace(recipe, noise=Noise.parse(noise))
        return drawn_unit(noisy, seed=1).samples[0].ranges

    assert (ranges("dropout:0") != ranges("motion:5")).mean() > 0.3
    refuses("corrected", ranges, "motion:5:corrected=true")


def test_a_recipe_file_says_its_noise_and_is_held_to_it(noisy, tmp_path):
    file, manifest = tmp_path / "it.toml", noisy.manifest
    file.write_text(recipe_text(manifest.tables, "it"))
    assert read_recipe(file) == manifest.recipe
    assert manifest.recipe.noise == Noise.parse(NOISE)
    refuses("near", read_recipe, file, noise="near")


@pytest.mark.parametrize("stages", ["rnage:0.02", "datasheet", "none,none", "range,none"])
def test_noise_that_is_not_to_be_had_is_refused(stages):
    refuses(stages, preset, "pillar", noise=stages)
    assert preset("pillar", noise="none") == preset("pillar")


def recipe_with(noise="", **mapping):
    return small_recipe(mapping=mapping, noise={"stages": noise})


def test_more_scans_show_more_of_the_same_maps(made, several):
    both = [dataset.split("train") for dataset in (Dataset(made), several)]
    assert of_poses(both[0]) == of_poses(both[1])
    for single, sample in zip(*both, strict=True):
        assert_array_equal(single.ranges, sample.ranges)
        assert (single.observed <= sample.observed).all()
        assert (sample.observed <= sample.occupancy & ~sample.free).all()
        points = single.points(frame="body")
        assert_array_equal(sample.points(frame="body")[: len(points)], points)
        assert len(sample.points()) == sum(len(scan.points()) for scan in sample.scans())
        assert sample.observed.sum() > single.observed.sum()


def test_earlier_scans_lie_back_along_the_flight(several):
    """Straight lines are shorter than what was flown, and the flight begins where it begins."""
    places = [[scan.pose.position for scan in sample.scans()] for sample in several.split("train")]
    steps = np.linalg.norm(np.diff(places, axis=1), axis=2)
    assert steps.max() <= 0.7 + 1e-9
    assert steps.max(axis=1).min() > 0.3
    assert (steps == 0.0).any()  # else no scan waits at the begin of its flight


AHEAD = {"fusion": "log-odds", "tilt_mps": 3.0, "map_ahead_m": (1.5, 0.2, -0.3)}


@pytest.mark.parametrize(("mapping", "noise"), [(SEVERAL, NOISE), (SEVERAL | AHEAD, "")])
def test_such_a_dataset_passes_every_check_whoever_makes_it(tmp_path, mapping, noise):
    recipe = recipe_with(noise, **mapping)
    options = {"seed": 3, "counts": {"train": 3, "val": 1, "test": 3}}
    compact = dataset_in(tmp_path / "one", recipe, compact=True, shard_samples=3, **options)
    assert [check for check in verify(compact.folder).checks if check.skipped or not check.ok] == []
    stored = dataset_in(tmp_path / "two", recipe, **options)
    assert stored.digest == compact.digest
    assert_array_equal(stored.split("test")[2].free, compact.split("test")[2].free)


@pytest.mark.filterwarnings("ignore:invalid value")  # no return less no return
def test_noise_of_earlier_scans_is_their_own_and_that_of_the_last_stays():
    variants = ("", SEVERAL), ("range:0.05", SEVERAL), ("range:0.05", {})
    units = [drawn_unit(recipe_with(noise, **of), 2, split="val").samples for noise, of in variants]
    for clean, noisy, single in zip(*units, strict=True):
        assert_array_equal(noisy.ranges, single.ranges)
        errors = noisy.earlier_ranges - clean.earlier_ranges
        drawn = [error[np.isfinite(error)] for error in errors]
        assert min(np.abs(error).max() for error in drawn) > 0.05
        assert len({error[:20].tobytes() for error in drawn}) == 3


@each_case("dataset/ahead", "heading shift", json.loads)
def test_a_map_that_lies_ahead_is_shifted_by_where_the_sensor_looks(heading, shift):
    """Five metres ahead, two to the left, one down."""
    grid, mapper = small_recipe().grid, Mapper(map_ahead_m=(5.0, 2.0, -1.0))
    pose = Pose.facing((7.0, -3.0, 2.0), heading)
    shifted = mapper.origin(grid, pose) - grid.origin_at(pose.position)
    assert_allclose(shifted, shift, atol=1e-12)


@each_case("dataset/mapping_changed", "field change checks")
def test_what_was_changed_in_earlier_scans_is_found(several, tmp_path, field, change, checks):
    folder = forge.copy(several.folder, tmp_path / "d")
    with h5py.File(folder / "train-00000.h5", "r+") as file:
        file[field][0, 1] += float(change)
    assert {*checks.split()} <= failed(folder).keys()


@each_case("dataset/mapping", "path value")
def test_a_strangers_word_is_not_trusted(several, noisy, tmp_path, path, value):
    original = several if "mapping" in path else noisy
    folder = forge.edit_at(forge.copy(original.folder, tmp_path / "d"), path, value)
    refuses(f"{path} {value}", lambda: Dataset(folder).split("train")[0].observed)


def test_too_many_rays_are_refused():
    tables = {"mapping": {"scans": 100}, "lidar": {"rows": 1000, "columns": 100}}
    refuses("10 million", make_recipe, "pillar", tables, where="test")


def test_options_of_generate_make_a_dataset_by_them(small, tmp_path, capsys):
    command = f"generate --recipe {small} --n 1 --val 0 --test 0 --workers 1 -o {tmp_path}/d"
    options = "--scans 3 --scan-spacing 0.2 --fusion log-odds --tilt 2 --map-ahead 1,0,-0.5"
    done(capsys, f"{command} {options} --labels group --normals --quiet")
    refuses_command(capsys, f"{command} --map-ahead 99,0,0 --force")  # which loses nothing
    expected = {"scans": 3, "scan_spacing_m": 0.2, "fusion": "log-odds", "tilt_mps": 2.0}
    dataset = Dataset(tmp_path / "d")
    assert dataset.manifest.mapping == Mapper(**expected, map_ahead_m=(1.0, 0.0, -0.5))
    sample = dataset.split("train")[0]
    assert (sample.return_normal.shape, sample.voxel_class.max()) == ((8, 24, 3), 1)
