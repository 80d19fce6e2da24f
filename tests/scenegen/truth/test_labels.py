"""Owners of voxels against distances written anew, and labels of samples and datasets."""

import dataclasses
import hashlib

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenegen.dataset.rescan import plan_rescan
from scipy.spatial.transform import Rotation

from lidarsim import GridSpec
from lidarsim.noise.chain import Noise
from scenegen.dataset.build import plan_dataset
from scenegen.errors import GenerationError
from scenegen.sample import GROUPS
from scenegen.share.stage import Request, stage
from scenegen.source import read_scenes
from scenegen.truth import rasterize
from scenegen.verification import verify
from scenegen.worlds.labels import NONE, SHAPES, class_names, labels_by, owners
from scenegen.worlds.world import compile_world
from tests.conftest import COUNTS, plan_of, scene_recipe, small_recipe
from tests.scenegen.conftest import built, drawn_unit
from tests.scenegen.truth.reference import Shape, at_least

CUBE = " ".join(f"{x} {y} {z}" for x in (-0.5, 0.5) for y in (-0.4, 0.4) for z in (-0.3, 0.3))
WORLD = f"""<mujoco><asset><mesh name="cube" vertex="{CUBE}"/></asset><worldbody>
<geom name="wall_2" type="box" size="0.35 0.3 0.5" pos="0.9 0.2 0.6" euler="0 0 30"/>
<geom type="plane" size="0 0 1"/>
<geom name="ball.001" type="sphere" size="0.4" pos="-0.3 0 0.7"/>
<geom name="same" type="sphere" size="0.4" pos="-0.3 0 0.7"/>
<geom name="crate7" type="mesh" mesh="cube" pos="-0.6 -0.9 0.6"/>
<geom name="wall_10_top" type="capsule" size="0.15 0.3" pos="0.4 1.1 0.9"/>
</worldbody></mujoco>"""


TURNED = Rotation.from_euler("z", 30, degrees=True).as_quat(scalar_first=True)
BALL = Shape("sphere", (0.4, 0, 0)).at((-0.3, 0, 0.7))
SOLIDS = [
    Shape("box", (0.35, 0.3, 0.5), quat=TURNED).at((0.9, 0.2, 0.6)),
    Shape("plane", (0, 0, 1)),
    *(BALL, BALL),
    Shape("box", (0.5, 0.4, 0.3)).at((-0.6, -0.9, 0.6)),
    Shape("capsule", (0.15, 0.3, 0)).at((0.4, 1.1, 0.9)),
]
"""The six geoms of `WORLD`."""


@pytest.mark.parametrize("shift", [0.0, 0.037])
def test_a_voxel_belongs_to_the_nearest_solid_and_of_two_to_the_first(shift):
    world = compile_world(WORLD.encode())
    grid, origin = GridSpec(shape=(18, 20, 12), voxel_m=0.2), np.array([-1.8, -2.0, -0.6]) + shift
    occupancy = rasterize(world.solids, grid, origin)
    owner = owners(world.solids, occupancy, grid, origin)
    assert_array_equal(owner != NONE, occupancy)
    cells = np.argwhere(occupancy)
    centres = origin + (cells + 0.5) * grid.voxel_m
    there = np.stack([np.maximum(at_least(solid, centres), 0.0) for solid in SOLIDS])
    found = owner[tuple(cells.T)]
    least = there.min(axis=0)
    assert_allclose(
        there[found, np.arange(len(found))], least, atol=1e-7
    )  # a mesh's vertices are float32
    first = np.argmax(there <= least + 1e-7, axis=0)
    assert (found == first).mean() > 0.99  # what rounding decides goes to either
    assert set(np.unique(found)) == {0, 1, 2, 4, 5}


def test_classes_come_from_names_shapes_or_groups():
    model = compile_world(WORLD.encode()).model
    assert class_names(model, "name") == ["wall", "plane", "ball", "same", "crate", "wall_top"]
    assert set(class_names(model, "group")) == {"group 0"}
    assert labels_by("name", {"wall", "box"}).classes == ("nothing", *SHAPES, "wall")
    with pytest.raises(
        GenerationError, match="geom 'wall_2' is of class 'wall', which was not known"
    ):
        labels_by("name", ()).of(compile_world(WORLD.encode()))
    codes = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_MESH
    assert [SHAPES[int(code)] for code in codes] == ["plane", "mesh"]


def test_labels_add_fields_and_change_none_and_their_digest_covers_them():
    recipe = small_recipe()
    with_labels = dataclasses.replace(recipe, labels=labels_by("name", ()))
    plain, more = (drawn_unit(it, seed=1).samples[0] for it in (recipe, with_labels))
    assert set(more.names) == set(plain.names) | set(GROUPS["labels"])
    for name in plain.names:
        assert_array_equal(getattr(plain, name), getattr(more, name))
    parts = b"".join(getattr(more, name).tobytes() for name in GROUPS["labels"])
    assert more.sha256() == hashlib.sha256(plain.sha256() + parts).digest()
    # a return lies in a voxel, or beside one, of its own geom: the voxel's centre may be nearer to
    # another
    classes = {SHAPES[int(n) - 1] for n in np.unique(more.return_class) if n}
    assert classes <= {"plane", "box", "cylinder"}
    assert (more.return_geom >= 0).sum() == np.isfinite(plain.ranges).sum()


def test_a_dataset_with_labels_is_kept_verified_published_and_scanned_again(undrawn, tmp_path):
    recipe = dataclasses.replace(small_recipe(), labels=labels_by("group", ()))
    plan = plan_of(tmp_path / "data", recipe, seed=3, counts=COUNTS, compact=True)
    dataset = built(plan)
    assert built(plan).manifest == dataset.manifest  # which finds every shard as it was
    same, noisy = (
        built(plan_rescan(dataset, tmp_path / name, chain=chain))
        for name, chain in (("same", None), ("noisy", Noise.parse("spurious:0.05,range")))
    )
    for one in (dataset, same, noisy):
        report = verify(one.folder)
        assert report.ok, report.failed
        assert {"labels", "owners"} <= {check.name for check in report.checks}
    assert dataset.manifest.digest == same.manifest.digest != noisy.manifest.digest
    split = dataset.split("train")
    assert split[0].voxel_class.max() == 1  # type: ignore[attr-defined]
    assert split.describe()["voxel_geom"]["dtype"] == "int32"
    request = Request(dataset=plan.folder, repository="ada/small", out=tmp_path / "out")
    stage(request, (("files", "all there"),))
    card = (tmp_path / "out" / "README.md").read_text()
    for said in ('"nothing", "group 0"', "`voxel_class`", "--labels group"):
        assert said in card


DRESSED = """<mujoco><asset>
<material name="oak_01" rgba="0.5 0.4 0.3 1"/><material name="oak_02" rgba="0.6 0.4 0.3 1"/>
<material name="steel"/><material name="unused"/></asset><worldbody>
<geom name="floor" type="plane" size="5 5 1" material="steel"/>
<geom type="box" size="0.8 0.8 0.8" pos="2 1 0.8" material="oak_01" group="3"/>
<geom type="sphere" size="0.7" pos="-2 -1 1" material="oak_02"/>
<geom type="cylinder" size="0.5 1" pos="2 -3 1" rgba="0.9 0.1 0.1 1"/>
</worldbody></mujoco>"""


def test_a_scenes_materials_make_classes_and_their_archive_keeps_them(tmp_path):
    file = tmp_path / "one.xml"
    file.write_text(DRESSED)
    counts = {"train": 6, "val": 0, "test": 0}
    found = []
    for by in (None, "material", "group"):
        source = read_scenes(file, counts, seed=0, materials=by == "material")
        labels = labels_by(by, source.class_names(by)) if by else None
        recipe = dataclasses.replace(scene_recipe(), labels=labels)
        found.append(built(plan_dataset(tmp_path / str(by), recipe, source, seed=1, counts=counts)))
    plain, dressed, grouped = found
    assert (
        b"oak" not in plain.world("train", 0)["world.xml"]
    )  # as in datasets of earlier commits, byte for byte
    assert b"oak_02" in dressed.world("train", 0)["world.xml"]
    assert b"unused" not in dressed.world("train", 0)["world.xml"]
    classes = list(dressed.manifest.labels["classes"])
    assert classes == ["nothing", *SHAPES, "oak", "steel"]
    assert verify(dressed.folder).ok
    named = "steel", "oak", "oak", "cylinder", "nothing"
    wanted = np.array([classes.index(name) for name in named])
    met = set()
    for n in range(counts["train"]):
        bare, material, group = (it.split("train")[n] for it in (plain, dressed, grouped))
        assert_array_equal(bare.occupancy, material.occupancy)
        assert_array_equal(bare.ranges, material.ranges)
        met |= set(np.unique(material.voxel_geom).tolist())
        assert_array_equal(material.voxel_class, wanted[material.voxel_geom])
        assert_array_equal(material.return_class, wanted[material.return_geom])
        assert_array_equal(group.voxel_class, np.array([1, 4, 1, 1, 0])[group.voxel_geom])
    assert met == {-1, 0, 1, 2, 3}
