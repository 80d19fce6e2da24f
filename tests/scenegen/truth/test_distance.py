"""The distance field is the exact distance between voxel centres, truncated, rounded once to
float32."""

import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy import ndimage

from lidarsim import GridSpec
from scenegen.truth import distance_field

VOXELS = (0.1, 0.2, 0.25)


def squares(occupancy):
    """Squared distances in voxels, whole numbers, infinite in an empty map: by scipy's transform of
    the free voxels.

    ``distance_transform_edt`` computes sqrt(k) in float64 for an integer k; rounding its square
    returns k.
    """
    if not occupancy.any():
        return np.full(occupancy.shape, np.inf)
    return np.rint(ndimage.distance_transform_edt(~occupancy) ** 2)


def expected_field(k, voxel, truncation):
    """The field of a map with the squared distances `k`."""
    return np.minimum(voxel * np.sqrt(k), truncation).astype(np.float32)


def field(occupancy, voxel, truncation):
    """The answer under test, and that it leaves its argument alone."""
    before = occupancy.copy()
    grid = GridSpec(shape=occupancy.shape, voxel_m=voxel, truncation_m=truncation)
    answer = distance_field(occupancy, grid)
    assert answer.dtype == np.float32
    assert answer.shape == occupancy.shape
    assert_array_equal(occupancy, before)
    return answer


@pytest.mark.parametrize("voxel", VOXELS)
@pytest.mark.parametrize("density", [0.0, 0.0001, 0.001, 0.02, 0.3, 0.97])
def test_the_field_is_scipys_to_the_last_bit(voxel, density, rng):
    for shape in ((23, 31, 17), (40, 9, 26), (5, 60, 40), (1, 33, 8), (12, 1, 1)):
        occupancy = rng.random(shape) < density
        expected = expected_field(squares(occupancy), voxel, 2.0)
        assert_array_equal(field(occupancy, voxel, 2.0), expected)


@pytest.mark.parametrize("voxel", VOXELS)
def test_truncations_of_every_reach_are_exact(voxel, rng):
    """From less than one voxel to farther than the map is wide, whole numbers and their
    neighbours."""
    occupancy = rng.random((19, 26, 22)) < 0.0005
    occupancy[4, 20, 7] = True
    k = squares(occupancy)
    lengths = "0.5 1 1.5 2 3 7 10 11 12 15 16 17 20 25 90 127 128 180 182 300"
    squared = "2 3 5 126 127 128 129 255 256 257"
    told, roots = np.loadtxt(lengths.split()), np.sqrt(np.loadtxt(squared.split()))
    for reach in [*told, *roots, *rng.uniform(0, 40, 20)]:
        metres = float(reach * voxel)
        for truncation in (metres, math.nextafter(metres, 0), math.nextafter(metres, 999)):
            answer = field(occupancy, voxel, truncation)
            assert_array_equal(answer, expected_field(k, voxel, truncation))
