"""Warp's truth, in its mode without a GPU: the bits of `rasterize` and `distance_field`, and of
whole samples."""

import numpy as np
import pytest

from lidarsim import AnalyticEngine, GridSpec
from lidarsim.pose import rotate
from lidarsim.solids.model import solids_of
from scenegen.draw import draw_unit
from scenegen.source import DrawnWorlds
from scenegen.truth import distance_field, rasterize
from tests.conftest import small_recipe
from tests.lidarsim.engines.test_laws import SIZES, model_of, random_model

wp = pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install -e '.[gpu]'")

from lidarsim.gpu.rays import cast, voxelize  # noqa: E402
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
def test_occupancy_and_distances_have_the_processors_bits(grid: GridSpec) -> None:
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
        np.testing.assert_array_equal(occupancy.numpy()[p], expected)
        np.testing.assert_array_equal(field.numpy()[p], distance_field(expected, grid))
    assert 0.001 < occupancy.numpy()[:-1].mean() < 0.9
    assert not occupancy.numpy()[-1].any()


@pytest.mark.parametrize("kind", ["pillar", "geometric"])
def test_samples_of_the_presets_have_the_same_bits(kind: str) -> None:
    """Rays, voxels, occupancy and distances of several flights at once, each through a world of its
    own."""
    recipe = small_recipe(kind)
    source, grid, reach = DrawnWorlds(recipe), recipe.grid, recipe.lidar.max_range_m
    units = [
        draw_unit(source, recipe, seed=0, split="train", unit=unit, engine=AnalyticEngine.of)
        for unit in range(3)
    ]
    samples = [sample for unit in units for sample in unit.samples]
    worlds = Worlds([unit.world.solids for unit in units], device="cpu")
    which = np.repeat(np.arange(len(units)), [len(unit.samples) for unit in units])
    origins = np.array([sample.position for sample in samples])
    directions = recipe.lidar.directions_body
    rays = np.array([rotate(sample.quaternion, directions).reshape(-1, 3) for sample in samples])
    corners = grid.origin_at(origins)
    ranges = cast(worlds, origins, rays, reach, which=which)
    observed, free = voxelize(ranges, origins, rays, reach, grid=grid, corners=corners)
    occupancy = gpu.rasterize(worlds, grid, corners, which=which)
    found = {
        "ranges": ranges.numpy().astype(np.float32).reshape(len(samples), *recipe.lidar.shape),
        "observed": observed.numpy(),
        "free": free.numpy(),
        "occupancy": occupancy.numpy(),
        "tudf": gpu.distance_field(occupancy, grid).numpy(),
    }
    for name, values in found.items():
        np.testing.assert_array_equal(
            values, [getattr(sample, name) for sample in samples], err_msg=name
        )
    assert found["observed"].any()


def test_what_a_kernel_cannot_take_is_refused_in_one_line() -> None:
    occupancy = wp.zeros((1, 4, 4, 4), dtype=wp.bool, device="cpu")
    with pytest.raises(ValueError, match=r"^occupancy: .* expected \(1, 5, 4, 4\)"):
        gpu.distance_field(occupancy, GridSpec(shape=(5, 4, 4)))
    worlds = Worlds([solids_of(random_model(np.random.default_rng(0)))], device="cpu")
    with pytest.raises(ValueError, match=r"grid\.hollow = True: expected False on the GPU"):
        gpu.rasterize(worlds, GridSpec(hollow=True), np.zeros((1, 3)))
