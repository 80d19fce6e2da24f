"""A map of voxels in a sample's grid, against sums over the overlaps of cubes."""

import numpy as np
import pytest

from lidarsim import GridSpec, Pose, cast
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelEngine, VoxelMap
from scenegen.truth.voxels import resample
from scenegen.worlds.recipe import preset


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


def test_returns_lie_in_occupied_voxels():
    rng, recipe = np.random.default_rng(2), preset("pillar")
    for edge_m in (0.08, 0.2, 0.33):
        shape = tuple((np.array([14.0, 14.0, 7.0]) / edge_m).astype(int))
        states = np.where(rng.random(shape) < 0.003, OCCUPIED, FREE).astype(np.uint8)
        voxels = VoxelMap(states, edge_m, np.array([-7.0, -7.0, -3.5]))
        position = rng.uniform(-0.2, 0.2, 3)
        scan = cast(VoxelEngine(voxels), recipe.lidar, Pose.level(position, 0.4))
        origin = recipe.grid.origin_at(position)
        occupancy, _ = resample(voxels, recipe.grid, origin)
        index = recipe.grid.index(scan.points(), origin)
        inside = ((index >= 0) & (index < recipe.grid.shape)).all(axis=1)
        assert inside.sum() > 100
        assert occupancy[tuple(index[inside].T)].all()
