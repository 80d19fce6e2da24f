"""Worlds from files: split by world, visited in turn, self-contained once archived; and kinds that
are one file."""

import itertools
from collections import Counter

import mujoco
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from scenegen import SPLITS
from scenegen.dataset.build import plan_dataset
from scenegen.draw.source import read_scenes
from scenegen.worlds.world import write_world
from tests.command_line import ROOT
from tests.conftest import THREE, scene_recipe
from tests.scenegen import refuses
from tests.scenegen.conftest import built

SCENES = ROOT / "scenes"
COUNTS = {"train": 9, "val": 3, "test": 3}
ROOM = """<mujoco><custom><numeric name="flight_bounds" data="0 0 1 12 12 3"/></custom><worldbody>
<geom type="plane" size="1 1 1"/><geom name="post{n}" type="cylinder" size="0.3 2" pos="{n} 6 2"/>
<geom type="box" size="0.5 0.5 0.5" pos="9 {n} 0.5"/><geom type="box" size="0.1 2 2" pos="3 9 2"/>
</worldbody>
    </mujoco>"""


@pytest.fixture
def folder(tmp_path):
    """Five small worlds."""
    (tmp_path / "worlds").mkdir()
    for n in range(5):
        (tmp_path / "worlds" / f"room{n}.xml").write_text(ROOM.format(n=n + 2))
    return tmp_path / "worlds"


def make(folder, out, counts=COUNTS):
    source = read_scenes(folder, counts, seed=0)
    plan = plan_dataset(out, scene_recipe(), source, seed=0, counts=counts, shard_samples=3)
    return source, built(plan)


def test_a_folder_is_split_by_world_and_visited_in_turn(folder, tmp_path):
    source, dataset = make(folder, tmp_path / "d", {**COUNTS, "train": 21})
    named = {split: [one.name for one in scenes] for split, scenes in source.scenes.items()}
    assert sorted(itertools.chain(*named.values())) == [f"room{n}.xml" for n in range(5)]
    assert list(map(len, named.values())) == [3, 1, 1]
    names = dataset.split("train").names
    assert Counter(world for _, world, _ in names) == {0: 9, 1: 6, 2: 6}
    assert [viewpoint for _, world, viewpoint in names if world == 0] == list(range(9))
    assert len(set(names)) == len(names)
    recorded = dataset.manifest.scenes["train"]
    assert [entry.file for entry in recorded] == named["train"]


def test_fewer_samples_of_a_folder_are_the_first_of_more(folder, tmp_path):
    _, small = make(folder, tmp_path / "small")
    _, large = make(folder, tmp_path / "large", {name: 2 * count for name, count in COUNTS.items()})
    for split, count in COUNTS.items():
        first = [sample.sha256() for sample in large.split(split)[:count]]
        assert [sample.sha256() for sample in small.split(split)] == first


def test_how_many_samples_are_asked_for_deals_no_world_otherwise(tmp_path):
    for n in range(14):
        (tmp_path / f"room{n:02d}.xml").write_text(ROOM.format(n=3 + n / 10))

    def dealt(n):
        counts = {"train": n, "val": max(n // 10, 1), "test": max(n // 5, 1)}
        return read_scenes(tmp_path, counts, seed=0).scenes

    assert dealt(5) == dealt(45) == dealt(4500)


def test_a_changed_scene_is_another_dataset(folder, tmp_path):
    make(folder, tmp_path / "d")
    (folder / "room3.xml").write_text(ROOM.format(n=11))
    refuses(r"scenes\.train\.\d\.sha256", make, folder, tmp_path / "d")


def test_too_few_worlds_for_the_splits_are_refused(folder):
    refuses(
        r"1 world for 3 splits.*bench --split train",
        read_scenes,
        folder / "room0.xml",
        COUNTS,
        seed=0,
    )
    for n in range(2, 5):
        (folder / f"room{n}.xml").unlink()
    (folder / "room1.xml").unlink()
    found = read_scenes(folder, {"train": 9, "val": None, "test": None}, seed=0)
    assert [len(found.scenes[split]) for split in SPLITS] == [1, 0, 0]
    refuses("no such file", read_scenes, folder / "absent", COUNTS, seed=0)


def test_assets_and_includes_travel_with_the_world(tmp_path):
    """What is archived alone gives the meshes that the files gave."""
    (tmp_path / "parts").mkdir()
    trimesh.creation.torus(1.0, 0.3).export(tmp_path / "parts" / "ring.stl")
    (tmp_path / "parts" / "more.xml").write_text(
        '<mujoco><worldbody><geom name="included" type="sphere" size="1" pos="2 6 2"/></worldbody>'
        "</mujoco>"
    )
    (tmp_path / "world.xml").write_text(
        '<mujoco><compiler meshdir="parts"/><asset><mesh name="ring" file="ring.stl"/></asset>'
        '<custom><numeric name="flight_bounds" data="0 0 1 12 12 4"/></custom><include '
        'file="parts/more.xml"/><worldbody><geom type="mesh" mesh="ring" pos="9 6 2" '
        'euler="40 0 0"/><geom type="plane" size="1 1 1"/></worldbody></mujoco>'
    )
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
    twin = """<mujoco><custom><numeric name="flight_bounds" data="0 0 1 12 12 3"/></custom>
    <worldbody>
    <geom type="box" size="0.1 2 2" pos="3 9 2"/><geom type="box" size="0.5 0.5 0.5" pos="9 3 0.5"/>
    <geom name="mast" type="cylinder" size="0.3 2" pos="3 6 2"/><geom type="plane"
    size="1 1 1"/></worldbody></mujoco>"""
    (folder / "twin.xml").write_text(twin)
    refuses(r"twin\.xml: the same world as room1\.xml", read_scenes, folder, COUNTS, seed=0)


def test_worlds_of_many_geoms_compile():
    """Which take more memory than MuJoCo gives a world by itself."""

    def add(spec):
        for n in range(12_000):
            place = [n % 100, n // 100, 0]
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], pos=place)

    world = write_world(add, flight_bounds=np.array([[0, 0, 1], [100, 100, 3]]))
    assert world.model.ngeom == 12_000
