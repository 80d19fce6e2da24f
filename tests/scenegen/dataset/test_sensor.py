"""A sensor in a dataset: a raster by its parameters, any other by its rays; and a stranger's word
on either."""

import dataclasses
import hashlib
import io
import json
import pickle

import numpy as np
import pytest

from lidarsim import BeamTable, Lidar
from scenegen.dataset.parameters import RAYS, recipe_text, sensor_entry, sensor_of, write_rays
from scenegen.dataset.read import Dataset
from scenegen.verification import verify
from scenegen.worlds.tables import read_toml
from tests.conftest import plan_of, small_recipe
from tests.refusals import refuses
from tests.scenegen import each_case
from tests.scenegen.conftest import built


@pytest.fixture(scope="module")
def table():
    """The rays of a small raster, as nine rows of a list, with times."""
    rays = BeamTable.of(Lidar(rows=8, columns=27)).rays.copy().reshape(9, 24, 4)
    rays[..., 3] = np.linspace(0.0, 0.1, 9)[:, None]
    return BeamTable(rays=rays, made_by="a test")


def build_with(folder, lidar, engine="mujoco", *, force=False):
    recipe = dataclasses.replace(small_recipe(), lidar=lidar)
    return built(plan_of(folder, recipe, seed=5, engine=engine), force=force)


def test_a_table_is_kept_read_verified_and_replaced(tmp_path, table):
    dataset = build_with(tmp_path, table)
    assert str(dataset.lidar) == "9 × 24 rays of a test, up to 10 m"
    assert dataset.lidar == pickle.loads(pickle.dumps(dataset.lidar)) == table
    assert dataset.split("train")[0].ranges.shape == (9, 24)
    assert np.load(tmp_path / RAYS, allow_pickle=False).shape == (9, 24, 4)
    assert verify(tmp_path).ok
    (tmp_path / RAYS).unlink()
    refuses("no rays", Dataset, tmp_path)
    assert build_with(tmp_path, table).lidar == table
    raster = Lidar(rows=8, columns=24)
    assert build_with(tmp_path, raster, force=True).lidar == raster
    assert not (tmp_path / RAYS).exists()


def npy(values):
    file = io.BytesIO()
    np.save(file, values, allow_pickle=values.dtype == object)
    return file.getvalue()


UNIT = np.tile([1.0, 0.0, 0.0, 0.0], (5, 1))
HEADER = (
    b"\x93NUMPY\x01\x00v\x00"
    + b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 4), }".ljust(117)
)


DAMAGED = {
    "empty": b"",
    "short": npy(UNIT)[:-8],
    "huge": HEADER + b"\n" + bytes(160),
    "float32": npy(UNIT.astype("f4")),
    "objects": npy(np.array([print], object)),
    "a ray too few": npy(UNIT[:4]),
    "nan": npy(np.full((5, 4), np.nan)),
    "long rays": npy(2.0 * UNIT),
    "negative times": npy(UNIT - [0, 0, 0, 1.0]),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_table_ends_in_one_line(tmp_path, case):
    (tmp_path / RAYS).write_bytes(DAMAGED[case])
    digest = hashlib.sha256(DAMAGED[case]).hexdigest()
    refuses(case, sensor_of, sensor_entry(BeamTable(rays=UNIT)) | {"sha256": digest}, tmp_path)


@each_case("dataset/sensor", "name value")
def test_a_strangers_word_on_a_table_is_not_trusted(tmp_path, name, value):
    table = BeamTable(rays=UNIT)
    write_rays(table, tmp_path)
    entry = sensor_entry(table)
    assert sensor_of(entry, tmp_path) == table
    refuses(f"{name} {value}", sensor_of, entry | {name: json.loads(value)}, tmp_path)


ODD = "y = 1\n[lidar]\nsensor = 'trap:Sensor'\nx = '''"


def test_no_text_of_a_manifest_adds_a_line_to_its_recipe_file(table, trap):
    """A sensor that one names would be imported."""
    made_by = "''' #"
    dataset = build_with(trap / "data", dataclasses.replace(table, made_by=made_by))
    tables = dataset.manifest.tables
    tables.accept[ODD] = 1
    (trap / "data" / "r.toml").write_text(recipe_text(tables, "it"))
    read = read_toml(trap / "data" / "r.toml")
    assert read["lidar"]["sensor"] == "table"
    assert read["lidar"]["made_by"] == made_by
    assert read["accept"][ODD] == 1


def test_an_engine_that_is_not_to_be_had_is_told_of_before_anything_is_made(tmp_path):
    refuses("mujocco", build_with, tmp_path / "data", Lidar(), "mujocco")
    assert not (tmp_path / "data").exists()
