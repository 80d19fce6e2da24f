"""Worlds from files: split by world, visited in turn, self-contained once archived; and kinds that
are one file."""

import itertools

import mujoco
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from scenegen import SPLITS
from scenegen.dataset.build import plan_dataset
from scenegen.draw.source import read_scenes
from scenegen.worlds.world import write_world
from tests.command_line import beside
from tests.conftest import THREE, scene_recipe
from tests.refusals import refuses
from tests.scenegen.conftest import built

COUNTS = {"train": 9, "val": 3, "test": 3}
ROOM = beside(__file__, "worlds/mjcf/room.xml")


@pytest.fixture
def folder(tmp_path):
    """Five small worlds."""
    worlds = tmp_path / "worlds"
    worlds.mkdir()
    for n in range(5):
        (worlds / f"room{n}.xml").write_text(ROOM.format(n=n + 2))
    return worlds


def make(folder, out, counts=COUNTS):
    source = read_scenes(folder, counts, seed=0)
    plan = plan_dataset(out, scene_recipe(), source, seed=0, counts=counts, shard_samples=3)
    return source, built(plan)


def test_a_folder_is_split_by_world_and_visited_in_turn(folder, tmp_path):
    source, dataset = make(folder, tmp_path / "d", {**COUNTS, "train": 21})
    named = {split: [scene.name for scene in scenes] for split, scenes in source.scenes.items()}
    assert sorted(itertools.chain(*named.values())) == [f"room{n}.xml" for n in range(5)]
    assert list(map(len, named.values())) == [3, 1, 1]
    visits = [[n // 3 % 3, n // 9 * 3 + n % 3] for n in range(21)]  # three viewpoints at a time
    assert [visit for _, *visit in dataset.split("train").names] == visits
    assert [entry.file for entry in dataset.manifest.scenes["train"]] == named["train"]
    _, small = make(folder, tmp_path / "small")
    for split, count in COUNTS.items():
        first = [sample.sha256() for sample in dataset.split(split)[:count]]
        assert [sample.sha256() for sample in small.split(split)] == first


def test_how_many_samples_are_asked_for_deals_no_world_otherwise(tmp_path):
    for n in range(14):
        (tmp_path / f"room{n:02d}.xml").write_text(ROOM.format(n=3 + n / 10))

    few, many = (
        read_scenes(tmp_path, {"train": n, "val": n // 5, "test": n // 3}, seed=0).scenes
        for n in (5, 4500)
    )
    assert few == many


def test_a_changed_scene_is_another_dataset(folder, tmp_path):
    make(folder, tmp_path / "d")
    (folder / "room3.xml").write_text(ROOM.format(n=11))
    refuses("room3", make, folder, tmp_path / "d")


def test_too_few_worlds_for_the_splits_are_refused(folder):
    for name in ("room0.xml", "absent"):
        refuses(name, read_scenes, folder / name, COUNTS, seed=0)
    for n in range(1, 5):
        (folder / f"room{n}.xml").unlink()
    source = read_scenes(folder, {"train": 9, "val": None, "test": None}, seed=0)
    assert [len(source.scenes[split]) for split in SPLITS] == [1, 0, 0]


def test_assets_and_includes_travel_with_the_world(tmp_path):
    """What is archived alone gives the meshes that the files gave."""
    (tmp_path / "parts").mkdir()
    trimesh.creation.torus(1.0, 0.3).export(tmp_path / "parts" / "ring.stl")
    for name, path in (("included", "parts/more.xml"), ("including", "world.xml")):
        (tmp_path / path).write_text(beside(__file__, f"worlds/mjcf/{name}.xml"))
    direct = mujoco.MjModel.from_xml_path(str(tmp_path / "world.xml"))
    _, dataset = make(tmp_path / "world.xml", tmp_path / "d", THREE)
    assets = dataset.world("train", 0)
    document = assets.pop("world.xml").decode()
    again = mujoco.MjModel.from_xml_string(document, assets)
    assert again.ngeom == direct.ngeom == 3
    assert_allclose(again.mesh_vert, direct.mesh_vert, atol=1e-7)
    for sample in dataset.split("train"):
        assert not (sample.observed & ~sample.occupancy).any()


def test_two_files_of_one_world_are_refused(folder):
    """Renamed and reordered, they could still come to lie in two splits."""
    (folder / "twin.xml").write_text(beside(__file__, "worlds/mjcf/twin.xml"))
    refuses("twin", read_scenes, folder, COUNTS, seed=0)


def test_worlds_of_many_geoms_compile():
    """Which take more memory than MuJoCo gives a world by itself."""

    def add(spec):
        for n in range(12_000):
            place = [n % 100, n // 100, 0]
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], pos=place)

    world = write_world(add, flight_bounds=np.array([[0, 0, 1], [100, 100, 3]]))
    assert world.model.ngeom == 12_000
