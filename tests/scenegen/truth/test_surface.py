"""Truth of surfaces alone: what lies wholly inside one solid is not occupied, and every return
still is."""

import dataclasses
import itertools

import numpy as np
import pytest

from lidarsim import GridSpec
from lidarsim.solids import solids_of
from scenegen.truth import rasterize
from tests.scenegen.truth import reference
from tests.scenegen.truth.test_occupancy import placed

EDGE = 24
CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


def eroded(shape, by):
    """A shape that lies in `shape`, everywhere `by` deep at least."""
    size = np.array(shape.size)
    if shape.kind == "plane":
        return shape.at(shape.pos - by * shape.rot[:, 2])
    smaller = size * (1 - by / size.min()) if shape.kind == "ellipsoid" else size - by
    return dataclasses.replace(shape, size=tuple(smaller))


@pytest.mark.parametrize("kind", reference.KINDS)
def test_what_lies_wholly_inside_a_solid_is_left_out(kind):
    """And nothing else is."""
    rng, inner = np.random.default_rng(list(kind.encode())), 0
    for _ in range(40):
        shape, voxel, origin = placed(kind, rng, EDGE)
        grid = GridSpec(shape=(EDGE,) * 3, voxel_m=voxel)
        solids = solids_of(reference.world_of(shape))
        solid = rasterize(solids, grid, origin)
        surface = rasterize(solids, dataclasses.replace(grid, hollow=True), origin)
        assert not (surface & ~solid).any()
        centres = grid.centres(origin)
        left_out = solid & ~surface
        inner += np.count_nonzero(left_out)
        # a cube lies in what is convex where its corners do
        cubes = centres[..., None, :] + CORNERS * voxel
        assert reference.points_inside(shape, cubes[left_out]).all()
        if kind == "plane" or min(shape.size) > 1e-4:
            deep = reference.points_inside(eroded(shape, 2e-6), cubes[surface])
            assert not deep.all(axis=1).any()
    assert inner > 500
