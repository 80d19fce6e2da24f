"""Parts of samples that are asked for: their fields, digest and laws, and what breaks these."""

import dataclasses
import json

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
from tests.scenegen import each_case
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


@each_case("dataset/parts", "name where change check")
def test_a_change_of_a_part_is_found_by_its_check_and_the_digest(
    whole, tmp_path, name, where, change, check
):
    """A change is a factor, and what is added, where there are solids, no returns, or anything."""
    folder, (factor, more) = forge.copy(whole, tmp_path / "d"), json.loads(change)

    def edit(arrays):
        masks = {"solids": arrays["occupancy"], "no returns": ~np.isfinite(arrays["ranges"])}
        place = 1, masks[where][1] if where else ...
        arrays[name][place] = arrays[name][place] * factor + more

    forge.edit(folder, "train-00000.h5", edit)
    assert {check, "digest"} <= failed(folder).keys()


@pytest.mark.parametrize("part", [{"colour": True}, {"labels": "colour"}])
def test_a_part_that_nobody_knows_is_refused_by_name(part):
    refuses(part, scenegen.generate, "pillar", 1, out="x", **part)
