"""Truth of surfaces alone: what lies wholly inside one solid is not occupied, and every return
still is."""

import dataclasses
import itertools

import numpy as np
import pytest

from lidarsim import GridSpec
from scenegen.truth import rasterize
from tests.scenegen.truth import reference
from tests.scenegen.truth.test_occupancy import compiled, placed

EDGE = 24
CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


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
def test_what_lies_wholly_inside_a_solid_is_left_out(kind):
    """And nothing else is."""
    rng, inner = np.random.default_rng(list(kind.encode())), 0
    for shape, voxel, origin, solids in compiled([placed(kind, rng, EDGE) for _ in range(40)]):
        grid = GridSpec(shape=(EDGE,) * 3, voxel_m=voxel)
        solid = rasterize(solids, grid, origin)
        surface = rasterize(solids, dataclasses.replace(grid, hollow=True), origin)
        assert not (surface & ~solid).any()
        centres = grid.centres(origin)
        left_out = centres[solid & ~surface]
        inner += len(left_out)
        points = np.concatenate([CORNERS, rng.uniform(-0.5, 0.5, (20, 3))]) * voxel
        assert reference.points_inside(shape, left_out[:, None] + points).all()
        if min(shape.size[: USED.get(kind, 3)]) > 1e-4:
            cubes = centres[surface][:, None] + CORNERS * voxel
            deep = reference.points_inside(eroded(shape, 2e-6), cubes)
            assert not deep.all(axis=1).any()
    assert inner > 500
