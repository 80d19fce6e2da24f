"""Owners of voxels against distances written anew, and labels of samples and datasets."""

import dataclasses

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation

from lidarsim import GridSpec
from scenegen.truth import rasterize
from scenegen.worlds.labels import NONE, SHAPES, class_names, classes_of, labels_by, owners
from scenegen.worlds.world import compile_world
from tests.command_line import beside
from tests.conftest import small_recipe
from tests.refusals import refuses
from tests.scenegen.conftest import drawn_unit
from tests.scenegen.truth.reference import Shape, at_least

WORLD = beside(__file__, "labelled.xml")
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
def test_a_voxel_belongs_to_the_nearest_solid(shift):
    """Of two as near, to the first."""
    solids = compile_world(WORLD.encode()).solids
    grid, origin = GridSpec(shape=(18, 20, 12), voxel_m=0.2), np.array([-1.8, -2.0, -0.6]) + shift
    occupancy = rasterize(solids, grid, origin)
    owner = owners(solids, occupancy, grid, origin)
    assert_array_equal(owner != NONE, occupancy)
    centres, owner = grid.centres(origin)[occupancy], owner[occupancy]
    distances = np.stack([np.maximum(at_least(solid, centres), 0.0) for solid in SOLIDS])
    least = distances.min(axis=0) + 1e-7  # a mesh's vertices are float32
    assert (distances[owner, np.arange(len(owner))] <= least).all()
    assert (owner == np.argmax(distances <= least, axis=0)).mean() > 0.99  # but for rounding
    assert set(np.unique(owner)) == {0, 1, 2, 4, 5}


def test_classes_come_from_names_shapes_or_groups():
    world = compile_world(WORLD.encode())
    names = class_names(world.model, "name")
    assert names == ["wall", "plane", "ball", "same", "crate", "wall_top"]
    assert set(class_names(world.model, "group")) == {"group 0"}
    assert labels_by("name", {"wall", "box"}).classes == ("nothing", *SHAPES, "wall")
    refuses("no wall", classes_of, world, labels_by("name", ()))
    codes = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_MESH
    assert [SHAPES[int(code)] for code in codes] == ["plane", "mesh"]


def test_returns_are_labelled_by_what_they_met():
    recipe = dataclasses.replace(small_recipe(), parts={"labels": labels_by("name", ())})
    sample = drawn_unit(recipe, seed=1).samples[0]
    classes = {SHAPES[int(n) - 1] for n in np.unique(sample.return_class) if n}
    assert classes <= {"plane", "box", "cylinder"}
    assert_array_equal(sample.return_geom >= 0, np.isfinite(sample.ranges))
