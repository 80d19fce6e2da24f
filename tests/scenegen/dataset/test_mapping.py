"""Datasets of several scans a sample, of leaning bodies, and of maps that lie ahead: pairs of the
same worlds."""

import dataclasses

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import Pose
from lidarsim.engines.analytic import AnalyticEngine
from scenegen.dataset.like import scan_again
from scenegen.dataset.read import Dataset
from scenegen.draw.draw import UnitKey
from scenegen.truth import rasterize
from scenegen.verification import verify
from scenegen.worlds.mapping import Mapper
from scenegen.worlds.recipe import make_recipe
from tests.command_line import done, refused
from tests.conftest import COUNTS, dataset_in, small_recipe
from tests.scenegen import cases, refuses
from tests.scenegen.conftest import drawn_unit
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

SEVERAL = {"scans": 4, "scan_spacing_m": 0.7}
FEW = {"train": 3, "val": 1, "test": 3}
SAME = ("occupancy", "tudf", "ranges", "position", "quaternion", "origin", "world", "viewpoint")


def recipe_with(noise="", **mapping):
    return small_recipe(mapping=mapping, noise={"stages": noise})


def made_with(folder, recipe, *, compact=False, **options):
    """The dataset of `made`, by another recipe."""
    options = {"shard_samples": 3, "counts": FEW} | options
    return dataset_in(folder, recipe, seed=3, compact=compact, **options)


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    """The dataset of `made`, with four scans a sample; not to be changed."""
    folder = tmp_path_factory.mktemp("several") / "pillar"
    made_with(folder, recipe_with(**SEVERAL), counts=COUNTS)
    return folder


def test_more_scans_show_more_of_the_same_maps(made, several):
    more = 0
    both = (Dataset(folder).split("train") for folder in (made, several))
    for one, other in zip(*both, strict=True):
        for name in SAME:
            assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.observed <= other.observed).all()
        assert (other.observed <= other.occupancy).all()
        assert not (other.free & other.observed).any()
        points = one.points(frame="body")
        assert_array_equal(other.points(frame="body")[: len(points)], points)
        assert len(other.points()) == sum(len(scan.points()) for scan in other.scans())
        more += int(other.observed.sum()) - int(one.observed.sum())
    assert more > 0


def test_earlier_scans_lie_back_along_the_flight(several):
    """Straight lines are shorter than what was flown, and the flight begins where it begins."""
    waited = 0
    for sample in Dataset(several).split("train"):
        steps = np.linalg.norm(
            np.diff([scan.pose.position for scan in sample.scans()], axis=0), axis=1
        )
        assert (steps <= 0.7 + 1e-9).all()
        waited += np.count_nonzero(steps == 0.0)
        assert steps.max() > 0.3
    assert waited > 0  # else no scan waits at the begin of its flight


@pytest.mark.parametrize(
    ("mapping", "compact", "noise"),
    [
        (SEVERAL, True, "range:0.02,dropout:0.05"),
        (
            {"scans": 3, "fusion": "log-odds", "tilt_mps": 3.0, "map_ahead_m": (1.5, 0.2, -0.3)},
            False,
            "",
        ),
    ],
)
def test_such_a_dataset_passes_every_check_whoever_makes_it(tmp_path, mapping, compact, noise):
    recipe = recipe_with(noise, **mapping)
    dataset = made_with(tmp_path / "one", recipe, compact=compact)
    assert not [check for check in verify(dataset.folder).checks if check.skipped or not check.ok]
    there = made_with(tmp_path / "two", recipe, compact=not compact, shard_samples=100)
    assert there.manifest.digest == dataset.manifest.digest
    # stored in one of the two, derived in the other
    assert_array_equal(there.split("test")[2].free, dataset.split("test")[2].free)


def test_noise_of_earlier_scans_is_their_own_and_that_of_the_last_stays():
    plain, faulty, alone = (
        drawn_unit(recipe, 2, split="val").samples
        for recipe in (
            recipe_with(**SEVERAL),
            recipe_with("range:0.05", **SEVERAL),
            recipe_with("range:0.05"),
        )
    )
    for clean, noisy, one in zip(plain, faulty, alone, strict=True):
        assert_array_equal(noisy.ranges, one.ranges)
        drawn = []
        for with_noise, without in zip(noisy.earlier_ranges, clean.earlier_ranges, strict=True):
            both = np.isfinite(with_noise) & np.isfinite(without)
            drawn.append((with_noise[both] - without[both])[:20])
            assert np.abs(with_noise[both] - without[both]).max() > 0.05
        assert len({each.tobytes() for each in drawn}) == 3


@pytest.mark.parametrize(
    ("heading", "shift"), [((1, 0), (5, 2, -1)), ((0, 1), (-2, 5, -1)), ((0, -1), (2, -5, -1))]
)
def test_a_map_that_lies_ahead_is_a_shifted_window_of_the_same_truth(heading, shift):
    """Five voxels ahead, two to the left, one down."""
    recipe = small_recipe(
        mapping={"map_ahead_m": (1.0, 0.4, -0.2)}, world={"density": (0.15, 0.15)}
    )
    unit, given = drawn_unit(recipe), {"names": (0, 0), "engine": AnalyticEngine.of}
    pose = Pose.facing(unit.samples[0].position, heading)
    again = scan_again(unit.world, [[pose]], recipe, UnitKey(0, "train", 0), **given)
    (sample,) = again.samples
    wide = dataclasses.replace(recipe.grid, shape=tuple(n + 12 for n in recipe.grid.shape))
    whole = rasterize(unit.world.solids, wide, wide.origin_at(pose.position))
    begin = 6 + np.array(shift)
    window = tuple(map(slice, begin, begin + recipe.grid.shape))
    assert_array_equal(sample.occupancy, whole[window])
    assert 0.005 < sample.occupancy.mean() < 0.9


@pytest.mark.parametrize(("field", "change", "checks"), cases("dataset/mapping_changed"))
def test_what_was_changed_in_earlier_scans_is_found(several, tmp_path, field, change, checks):
    folder = forge.copy(several, tmp_path / "d")
    with h5py.File(folder / "train-00000.h5", "r+") as file:
        file[field][0, 1] += float(change)
    assert {*checks.split()} <= failed(folder).keys()


@pytest.mark.parametrize(("path", "value", "told"), cases("dataset/mapping"))
def test_a_strangers_word_is_not_trusted(several, tmp_path, path, value, told):
    folder = forge.edit_at(forge.copy(several, tmp_path / "d"), path, value)
    refuses(told, lambda: Dataset(folder).split("train")[0].observed)


def test_too_many_rays_are_refused():
    tables = {"mapping": {"scans": 100}, "lidar": {"rows": 1000, "columns": 100}}
    refuses(
        r"scans = 100: of 100000 rays each; expected 40 at most",
        make_recipe,
        "pillar",
        tables,
        where="test",
    )


def test_the_command_line_takes_it_and_refuses_the_impossible_in_one_line(small, tmp_path, capsys):
    command = f"generate --recipe {small} --n 3 --val 0 --test 0 --workers 1 --out {tmp_path}/d"
    options = "--scans 3 --scan-spacing 0.2 --fusion log-odds --tilt 2 --map-ahead 1,0,-0.5"
    done(capsys, f"{command} {options} --quiet")
    mapping = Dataset(tmp_path / "d").manifest.mapping
    expected = {"scans": 3, "scan_spacing_m": 0.2, "fusion": "log-odds", "tilt_mps": 2.0}
    assert mapping == Mapper(**expected, map_ahead_m=(1.0, 0.0, -0.5))
    for option in ("--scans 0", "--map-ahead 99,0,0"):
        refused(capsys, f"{command} {option} --force")
        assert Dataset(tmp_path / "d").manifest.mapping == mapping  # what was there is not lost
