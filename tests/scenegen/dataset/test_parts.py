"""Parts of samples that are asked for: their fields, digest and laws, and what breaks these."""

import dataclasses

import numpy as np
import pytest

import scenegen
from scenegen.draw.parts import PARTS
from scenegen.draw.parts.normals import Normals
from scenegen.draw.sample import GROUPS
from scenegen.verification import verify
from scenegen.worlds.labels import labels_by
from tests.conftest import dataset_in, small_recipe
from tests.refusals import refuses
from tests.scenegen.conftest import drawn_unit, same
from tests.scenegen.verification import forge
from tests.scenegen.verification.conftest import failed

SETTINGS = {"labels": labels_by("class", ()), "normals": Normals()}
"""Movers, which labels do not go with, have tests of their own."""


def with_parts(*names, **tables):
    parts = {name: SETTINGS[name] for name in names}
    return dataclasses.replace(small_recipe(**tables), parts=parts)


@pytest.fixture(scope="session")
def whole(once):
    """A dataset with every part; not to be changed."""
    recipe = with_parts(*SETTINGS)
    return once("parts", lambda folder: dataset_in(folder / "d", recipe)) / "d"


@pytest.mark.parametrize("names", [["labels"], ["normals"], ["normals", "labels"]])
def test_parts_add_fields_and_change_none(names):
    plain, sample = (
        drawn_unit(it, seed=1).samples[0] for it in (small_recipe(), with_parts(*names))
    )
    added = [field for name in PARTS if name in names for field in GROUPS[name]]
    assert sample.names == (*plain.names, *added)
    assert same(dataclasses.replace(sample, **dict.fromkeys(added)), plain)


def test_a_dataset_with_parts_passes_every_check(whole):
    report = verify(whole)
    assert report.ok, report.failed
    counts = {check.name: check.counts.get("samples") for check in report.checks}
    assert (counts["parts"], counts["part-laws"]) == (3, 3 * len(SETTINGS))


def test_with_noise_parts_are_of_what_the_clean_ray_met(tmp_path):
    recipe = with_parts(*SETTINGS, noise={"stages": "spurious:0.1,dropout:0.2"})
    dataset = dataset_in(tmp_path / "d", recipe)
    assert failed(dataset.folder) == {}
    sample = dataset.split("train")[0]
    has_normal = np.linalg.norm(sample.return_normal, axis=-1) > 0.5
    assert not (has_normal & ~np.isfinite(sample.ranges)).any()


def test_normals_look_back_at_the_sensor():
    sample = drawn_unit(with_parts("normals"), seed=1).samples[0]
    rays, normals = sample.points() - sample.position, sample.return_normal
    towards = (normals[np.isfinite(sample.ranges)] * rays).sum(axis=1)
    assert len(towards) > 20
    assert towards.max() < 0


def within(mask, value):
    """A change of a field of a sample, where a mask holds."""

    def change(values, sample):
        values[mask(sample)] = value

    return change


def solid(sample):
    return sample["occupancy"]


CHANGES = {
    "flipped": ("return_normal", lambda values, sample: np.negative(values, out=values), "parts"),
    "longer": ("return_normal", lambda values, sample: np.multiply(values, 1.1, out=values), ""),
    "of nothing": ("return_normal", within(lambda it: ~np.isfinite(it["ranges"]), (0, 0, 1)), ""),
    "unowned": ("voxel_geom", within(solid, -1), ""),
    "of another geom": ("voxel_geom", within(solid, 1), "parts"),
    "classless": ("return_class", within(lambda it: slice(None), 0), ""),
    "of no class": ("voxel_class", within(solid, 999), ""),
}
"""By name: a field, how it is changed, and the check that finds it, by default that of laws."""


@pytest.mark.parametrize("case", CHANGES)
def test_a_change_of_a_part_is_found_by_its_check_and_the_digest(whole, tmp_path, case):
    folder, (name, change, check) = forge.copy(whole, tmp_path / "d"), CHANGES[case]

    def edit(arrays):
        change(arrays[name][1], {field: values[1] for field, values in arrays.items()})

    forge.edit(folder, "train-00000.h5", edit)
    assert {check or "part-laws", "digest"} <= failed(folder).keys()


@pytest.mark.parametrize("part", [{"colour": True}, {"labels": "colour"}])
def test_a_part_that_nobody_knows_is_refused_by_name(part):
    refuses(part, scenegen.generate, "pillar", 1, out="x", **part)
