"""Truth of surfaces alone: what lies wholly inside one solid is not occupied, and every return
still is."""

import dataclasses
import itertools

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import GridSpec
from scenegen.truth import distance_field, rasterize
from scenegen.worlds.recipe import preset
from tests.scenegen.conftest import drawn_unit
from tests.scenegen.truth import reference
from tests.scenegen.truth.test_occupancy import compiled, placed

EDGE = 24
CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


def both(solids, shape, voxel, origin):
    """Solid truth, and surface truth."""
    grid = GridSpec(shape=shape, voxel_m=voxel)
    return [
        rasterize(solids, dataclasses.replace(grid, hollow=hollow), origin)
        for hollow in (False, True)
    ]


USED = {"sphere": 1, "capsule": 1, "cylinder": 2}
"""How many sizes of a shape are lengths across; three of the others."""


def eroded(shape, by):
    """A shape that lies in `shape`, everywhere `by` deep at least."""
    size = np.array(shape.size, float)
    if shape.kind == "plane":
        return shape.at(shape.pos - by * shape.rot[:, 2])
    if shape.kind == "ellipsoid":
        size *= 1 - by / size.min()
    else:
        size[: USED.get(shape.kind, 3)] -= by
    return dataclasses.replace(shape, size=tuple(size))


@pytest.mark.parametrize("kind", reference.KINDS)
def test_what_is_left_out_lies_wholly_inside_one_solid_and_nothing_else_does(kind):
    rng = np.random.default_rng(list(kind.encode()))
    inner = 0
    for shape, voxel, origin, solids in compiled([placed(kind, rng, EDGE) for _ in range(40)]):
        solid, surface = both(solids, (EDGE,) * 3, voxel, origin)
        assert not (surface & ~solid).any()
        centres = reference.voxel_centres(solid.shape, voxel, origin)
        left_out = centres[solid & ~surface]
        inner += len(left_out)
        points = np.concatenate([CORNERS, rng.uniform(-0.5, 0.5, (20, 3))]) * voxel
        assert reference.points_inside(shape, left_out[:, None] + points).all()
        if min(shape.size[: USED.get(kind, 3)]) > 1e-4:
            cubes = centres[surface][:, None] + CORNERS * voxel
            deep = reference.points_inside(eroded(shape, 2e-6), cubes)
            assert not deep.all(axis=1).any()
    assert inner > 500


def test_every_return_lies_in_a_surface_voxel_and_scans_do_not_depend_on_truth():
    plain = preset("geometric")
    grid = dataclasses.replace(plain.grid, hollow=True)
    solid, surface = (
        drawn_unit(recipe).samples for recipe in (plain, dataclasses.replace(plain, grid=grid))
    )
    for one, other in zip(solid, surface, strict=True):
        assert_array_equal(one.ranges, other.ranges)
        assert not (other.observed & ~other.occupancy).any()
        assert not (other.occupancy & ~one.occupancy).any()
        assert_array_equal(other.tudf, distance_field(other.occupancy, grid))
        assert 0.3 < other.occupancy.sum() / one.occupancy.sum() < 1
