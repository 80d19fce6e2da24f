"""The audit of stored ranges: which engine makes it, where the rays point, how much of a difference
is one."""

import weakref

import numpy as np
import pytest

from lidarsim import GridSpec, Lidar, MujocoEngine, Pose, cast
from lidarsim.engines import ENGINES
from scenegen.verification.check import auditor
from scenegen.verification.rays import SLACK_M, audit, count_strays, disagrees
from scenegen.worlds.world import compile_world

WORLD = b"""<mujoco><worldbody><geom type="box" size="1 2 3" pos="4 0 0"/>
<geom type="sphere" size="1" pos="-3 1 0"/>
</worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("made_with", "audits"), [("mujoco", "AnalyticEngine"), ("analytic", "MujocoEngine")]
)
def test_the_engine_that_audits_is_never_the_one_that_made_the_ranges(made_with, audits):
    world = compile_world(WORLD)
    engine = auditor(world, made_with)
    assert type(engine).__name__ == audits
    lidar, pose = Lidar(rows=8, columns=30, max_range_m=6.0), Pose.level((0.0, 0.0, 0.0), 0.4)
    ranges = cast(ENGINES.find(made_with).of(world.model), lidar, pose).ranges

    def audited(ranges):
        seen = ranges, pose.position, pose.quaternion
        return audit(*seen, lambda rays: engine, lidar, solids=2, rng=np.random.default_rng(0))

    numbers, found, gap = audited(ranges)
    assert len(numbers) == 240
    assert np.isfinite(found).sum() > 20
    assert not disagrees(gap, found, 6.0).any()
    _, found, gap = audited(ranges + np.float32(1e-5))
    assert disagrees(gap, found, 6.0).sum() > 20


def test_an_engine_of_a_users_own_is_audited_by_mujoco_and_not_imported():
    world = compile_world(WORLD)
    engine = auditor(world, "my_engines:Fast")
    assert isinstance(engine, MujocoEngine)
    assert auditor(world, "analytic") is engine
    gone = weakref.ref(world)
    del world
    assert gone() is None  # what casts goes with its world


def test_a_micrometre_and_a_half_is_too_much():
    gap = np.array([0.9e-6, 2.5e-6, 0.01, np.nan])
    found = disagrees(gap, np.array([1.0, 1.0, 10.0, 1.0]), 10.0)
    assert found.tolist() == [False, True, True, True]


@pytest.mark.parametrize("bound_m", [0.0, 0.05, 0.3, 1.1, 50.0])
def test_strays_are_those_of_a_slow_search(bound_m, rng):
    grid, origin = GridSpec(shape=(16, 12, 9), voxel_m=0.2), np.array([1.0, -2.0, 0.5])
    occupancy = rng.random(grid.shape) < 0.01
    extent = np.array(grid.shape) * grid.voxel_m
    points = origin + rng.uniform(-0.5, extent + 0.5, (400, 3))
    corners = origin + np.argwhere(occupancy) * grid.voxel_m
    gaps = np.maximum(corners - points[:, None], points[:, None] - corners - grid.voxel_m).clip(0)
    nearest = np.sqrt((gaps**2).sum(axis=2)).min(axis=1)
    inside = points - origin
    deep = np.minimum(inside, extent - inside).min(axis=1)
    expected = np.count_nonzero((nearest > bound_m + SLACK_M) & (deep >= bound_m + SLACK_M))
    assert count_strays(points, occupancy, grid, origin, bound_m) == expected
    assert (expected > 0) == (bound_m < 0.5)
