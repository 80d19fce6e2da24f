"""Laws of a unit's samples: what was seen is there, and what was drawn once is drawn again."""

import json
from collections import Counter

import mujoco
import numpy as np
import pytest
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from lidarsim import MujocoEngine, Pose, cast, voxelize
from scenegen.base.errors import GenerationError
from scenegen.truth import rasterize
from scenegen.worlds.recipe import preset
from scenegen.worlds.world import compile_world
from tests.command_line import rows
from tests.conftest import picky_recipe, small_recipe
from tests.scenegen.conftest import drawn_unit, same

QUARTER = Rotation.from_euler("z", 90, degrees=True)


def test_a_unit_depends_on_its_numbers_alone(drawn):
    recipe, _ = drawn
    alone = drawn_unit(recipe, 3)
    others = [drawn_unit(recipe, unit) for unit in (5, 0, 4)]
    again = drawn_unit(recipe, 3)
    assert alone.world.mjcf == again.world.mjcf
    assert all(map(same, alone.samples, again.samples))
    others += drawn_unit(recipe, 3, seed=1), drawn_unit(recipe, 3, split="val")
    for other in others:
        assert not any(map(same, alone.samples, other.samples))
        assert alone.world.mjcf != other.world.mjcf


def test_viewpoints_are_level_apart_and_clear_of_solids(drawn):
    recipe, _ = drawn
    for unit in range(3):
        found = drawn_unit(recipe, unit)
        positions = np.array([sample.position for sample in found.samples])
        assert pdist(positions).min() >= recipe.flight.spacing_m
        low, high = found.world.flight_bounds
        assert ((positions >= low) & (positions <= high)).all()
        for sample in found.samples:
            assert sample.quaternion[1] == sample.quaternion[2] == 0
            clear = found.world.clearance.at(*sample.position)  # which test_clearance proves
            assert clear >= recipe.flight.robot_radius_m - 2e-3


def turned(quaternion):
    """An attitude, after a quarter turn to the left."""
    attitude = Rotation.from_quat(quaternion.copy(), scalar_first=True)
    return (QUARTER * attitude).as_quat(scalar_first=True)


@pytest.mark.parametrize("kind", ["pillar", "geometric"])
def test_turning_the_world_by_a_right_angle_turns_the_sample(kind):
    recipe = preset(kind)
    unit = drawn_unit(recipe, 1)
    spec = mujoco.MjSpec.from_string(unit.world.mjcf.decode())
    for geom in spec.geoms:
        geom.pos, geom.quat = QUARTER.apply(geom.pos), turned(geom.quat)
    world = compile_world(spec.to_xml().encode())
    cells = 0
    for sample in unit.samples:
        pose = Pose(QUARTER.apply(sample.position.copy()), turned(sample.quaternion))
        seen = voxelize(cast(MujocoEngine.of(world.model), recipe.lidar, pose), recipe.grid)
        truth = rasterize(world.solids, recipe.grid, seen.origin)
        # MJCF prints six digits, so the turned world is off by some 1e-5 m and a few voxels may
        # differ
        pairs = (seen.observed, sample.observed), (seen.free, sample.free)
        for ours, theirs in (*pairs, (truth, sample.occupancy)):
            expected = np.rot90(theirs, axes=(0, 1))
            assert (ours != expected).mean() < 2e-4
            assert (ours & expected).sum() > 0.97 * expected.sum()
        cells += int((truth != truth[:, ::-1]).sum())
    assert cells > 1000  # else the world looks the same turned, and the test shows nothing


def test_rejected_worlds_and_viewpoints_are_counted_by_reason():
    recipe = picky_recipe()
    rejected = Counter()
    for number in range(12):
        unit = drawn_unit(recipe, number)
        rejected += sum(unit.rejected.values(), Counter())
        for sample in unit.samples:
            assert sample.occupancy.mean() >= recipe.accept.min_occupied_share
            assert np.isfinite(sample.ranges).mean() >= recipe.accept.min_returned_share
    assert rejected["few_solids"] > 0
    assert rejected["few_occupied"] + rejected["few_returns"] > 0


IMPOSSIBLE = """
{"world": {"density": [6, 6]}}           → world.density
{"accept": {"min_solids": 1e6}}          → accept.min_solids
{"accept": {"min_returned_share": 1}}    → accept.min_returned_share
{"flight": {"viewpoints": 500}}          → flight.viewpoints
"""


@pytest.mark.parametrize(("tables", "named"), rows(IMPOSSIBLE))
def test_impossible_parameters_end_and_are_named(tables, named):
    tables = {"accept": {}} | json.loads(tables)
    tables["accept"]["max_draws"] = 4
    recipe = small_recipe(**tables)
    with pytest.raises(GenerationError, match=named):
        drawn_unit(recipe)
