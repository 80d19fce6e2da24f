"""Warp's truth, in its mode without a GPU: the bits of `rasterize` and `distance_field`.

Whole samples of a preset are compared by `benchmarks/gpu.py`, which a smoke test runs.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim import GridSpec
from lidarsim.solids.model import solids_of
from scenegen.truth import distance_field, rasterize
from tests.lidarsim.engines.test_laws import SIZES, model_of, random_model

wp = pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install -e '.[gpu]'")

from lidarsim.gpu.worlds import Worlds  # noqa: E402
from scenegen.truth import gpu  # noqa: E402


@pytest.mark.parametrize(
    "grid",
    [
        GridSpec(shape=(60, 50, 20), voxel_m=0.4),
        GridSpec(shape=(30, 33, 41), voxel_m=0.13, truncation_m=0.41),
        GridSpec(shape=(1, 7, 5), voxel_m=2.0, truncation_m=9.0),
    ],
)
def test_occupancy_and_distances_have_the_processors_bits(grid):
    rng = np.random.default_rng(3)
    solids = [solids_of(random_model(rng)) for _ in range(3)]
    upright = (
        f'type="{shape}" size="{size}" pos="0.4 0.8 -4.6" euler="0 0 30"'
        for shape, size in SIZES.items()
    )
    solids += [solids_of(model_of(*upright)), solids_of(model_of())]
    which = np.array([0, 1, 2, 2, 3, 4])
    corners = rng.uniform([-2, -2, -3], [0, 0, -1], (len(which), 3))
    corners[4] = [-0.8, -0.8, -5.2]  # where the solids' faces are the voxels'
    occupancy = gpu.rasterize(Worlds(solids, device="cpu"), grid, corners, which=which)
    field = gpu.distance_field(occupancy, grid)
    for p, world in enumerate(which):
        expected = rasterize(solids[world], grid, corners[p])
        assert_array_equal(occupancy.numpy()[p], expected)
        assert_array_equal(field.numpy()[p], distance_field(expected, grid))
    assert 0.001 < occupancy.numpy()[:-1].mean() < 0.9
    assert not occupancy.numpy()[-1].any()


def test_what_a_kernel_cannot_take_is_refused_in_one_line():
    occupancy = wp.zeros((1, 4, 4, 4), dtype=wp.bool, device="cpu")
    with pytest.raises(ValueError, match=r"^occupancy: .* expected \(1, 5, 4, 4\)"):
        gpu.distance_field(occupancy, GridSpec(shape=(5, 4, 4)))
    worlds = Worlds([solids_of(random_model(np.random.default_rng(0)))], device="cpu")
    with pytest.raises(ValueError, match=r"grid\.hollow = True: expected False on the GPU"):
        gpu.rasterize(worlds, GridSpec(hollow=True), np.zeros((1, 3)))
