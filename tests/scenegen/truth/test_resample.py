"""A map of voxels in a sample's grid, against sums over the overlaps of cubes."""

import numpy as np
import pytest

from lidarsim import GridSpec
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelMap
from scenegen.truth.voxels import resample


@pytest.mark.parametrize("edge_m", [0.2, 0.08, 0.5, 0.3])
def test_occupied_and_known_voxels_are_those_that_overlap(edge_m, rng):
    states = rng.choice([UNKNOWN, FREE, OCCUPIED], (12, 10, 8), p=[0.5, 0.48, 0.02])
    voxels = VoxelMap(np.asfortranarray(states, np.uint8), edge_m, np.array([-1.0, 0.2, 0.0]))
    grid = GridSpec(shape=(9, 8, 7), voxel_m=0.2)
    for shift in (0.0, 0.07):
        origin = voxels.origin + np.array([2, -1, 1]) * 0.2 + shift
        occupancy, known = resample(voxels, grid, origin)
        overlaps = []
        for axis in range(3):
            low = origin[axis] + np.arange(grid.shape[axis])[:, None] * 0.2
            begin = voxels.origin[axis] + np.arange(states.shape[axis]) * edge_m
            overlaps.append(np.minimum(low + 0.2, begin + edge_m) - np.maximum(low, begin))
        touched = [np.where(one > 1e-6, 1.0, 0.0) for one in overlaps]
        count = np.einsum("ia,jb,kc,abc->ijk", *touched, states == OCCUPIED)
        shares = [np.maximum(one, 0.0) / 0.2 for one in overlaps]
        free = np.einsum("ia,jb,kc,abc->ijk", *shares, states == FREE)
        assert (occupancy == (count > 0)).all()
        sure = abs(free - 0.5) > 1e-6
        assert (known == ((count > 0) | (free >= 0.5)))[sure].all()
        assert known.any()
        assert not known.all()
