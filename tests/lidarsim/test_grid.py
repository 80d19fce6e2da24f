"""The grid: indices and centres are each other's inverse, and a face belongs to the voxel above
it."""

import itertools
import json

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import GridSpec
from tests.scenegen import cases, each_case


@each_case("../lidarsim/grids", "shape voxel_m", json.loads)
def test_the_grid_lies_around_its_position_and_a_centres_index_is_its_voxel(shape, voxel_m):
    grid = GridSpec(shape=shape, voxel_m=voxel_m)
    assert_array_equal(grid.extent_m, [n * voxel_m for n in shape])
    for position in np.loadtxt(sum(cases("../lidarsim/positions"), ())):
        origin = grid.origin_at(position)
        centres = grid.centres(origin)
        assert_array_equal(grid.index(centres, origin), np.moveaxis(np.indices(grid.shape), 0, -1))
        assert_allclose(centres.mean(axis=(0, 1, 2)), position, rtol=0, atol=1e-9)


def test_a_face_belongs_to_the_voxel_above_it():
    """With an edge and an origin that float64 holds exactly, so that points lie right on faces."""
    grid, origin = GridSpec(shape=(4, 4, 4), voxel_m=0.25), np.array([-1.5, 0.75, 8.0])
    for corner in itertools.product(range(-2, 6), repeat=3):
        face = origin + 0.25 * np.array(corner)
        assert_array_equal(grid.index(face, origin), corner)
        assert_array_equal(grid.index(face - 1e-9, origin), np.array(corner) - 1)
        assert_array_equal(grid.index(face + 0.25 - 1e-9, origin), corner)
