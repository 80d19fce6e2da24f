"""Every stage against the distribution that it states: moments, and a statistical test with a fixed
seed."""

import dataclasses
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from lidarsim import AnalyticEngine, BeamTable, MujocoEngine, Pose, Scan, cast
from lidarsim.noise.chain import Noise
from lidarsim.noise.losses import Dropout, Grazing, Motion, Spurious
from lidarsim.noise.ranges import Depth, Divergence, Near, Quantise
from lidarsim.noise.returns import Intensity, albedo_of
from tests.lidarsim.engines.test_laws import model_of
from tests.refusals import refuses
from tests.scenegen import each_case

RAYS = 20_000
REACH_M = 50.0
LEVEL = Pose(np.zeros(3), np.eye(4)[0])


def ahead(count, tilt_deg=0):
    """A sensor whose rays all go straight ahead, or as far to either side of that."""
    cosine, sine = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    rays = np.resize([[cosine, sine, 0.0, 0.0], [cosine, -sine, 0.0, 0.0]], (count, 4))
    return BeamTable(rays=rays, max_range_m=REACH_M)


def observed(scan, engine, *stages, albedo=None):
    """What stages make of a scan."""
    return Noise(stages).observe(scan, engine, rng=np.random.default_rng(5), albedo=albedo)


def applied(stage, ranges, tilt_deg=0):
    """What a stage that asks the engine nothing makes of ranges (n,)."""
    scan = Scan(np.float32(ranges), LEVEL, ahead(len(ranges), tilt_deg))
    return observed(scan, None, stage).ranges[0]


def wall(turn_deg, grey=0.4, at_m=10.0):
    """A wide wall ahead, its normal turned by `turn_deg` away from the sensor."""
    look = f'euler="0 0 {turn_deg}" rgba="{grey} {grey} {grey} 1"'
    thick = 0.5 / math.cos(math.radians(turn_deg))
    return f'type="box" size="0.5 90 90" pos="{at_m + thick} 0 0" {look}'


def is_normal(values):
    return stats.kstest(values, "norm").pvalue > 0.01


def as_often(chosen, share):
    """Whether rays (n,) may have been chosen with this probability."""
    return stats.binomtest(int(chosen.sum()), chosen.size, share).pvalue > 0.01


@each_case("../lidarsim/normal", "stage tilt_deg sigma_m")
def test_noise_is_normal(stage, tilt_deg, sigma_m):
    """That of a depth grows with its square, and not with that of the range."""
    (stage,), tilt_deg, sigma_m = Noise.parse(stage).stages, int(tilt_deg), float(sigma_m)
    moved = applied(stage, np.full(RAYS, 8.0), tilt_deg) - 8.0
    assert moved.std() == pytest.approx(sigma_m, rel=0.02)
    assert is_normal(moved / sigma_m)
    assert np.abs(moved).max() <= stage.bound_m(8.0) + 1e-12
    if not (tilt_deg and isinstance(stage, Depth)):
        assert stage.bound_m(8.0) == pytest.approx(4 * sigma_m)


def test_steps_and_the_least_range_are_exact():
    ranges = np.random.default_rng(1).uniform(1, 40, 99).astype(np.float32).astype(float)
    stage = Quantise(step_m=0.05)
    assert_allclose(applied(stage, ranges), 0.05 * np.rint(ranges / 0.05), atol=1e-9)
    assert stage.bound_m(REACH_M) == 0.025
    near = applied(Near(min_range_m=0.5), [0.1, 0.499, 0.5, 7.0])
    assert near.tolist() == [np.inf, np.inf, 0.5, 7.0]


@each_case("../lidarsim/lost", "stage turn_deg grey at_m share")
def test_returns_are_lost_with_the_stated_probability(stage, turn_deg, grey, at_m, share):
    """10 % reflectivity head on is found up to 5.5 m, so 0.4 up to 11 m, and at 60° up to 7.8 m."""
    (stage,), share = Noise.parse(stage).stages, float(share)
    ranges = seen(stage, wall(float(turn_deg), float(grey), float(at_m))).ranges[0]
    lost = np.isinf(ranges)
    assert as_often(lost, share)
    assert len(np.unique(ranges[~lost])) <= 1
    runs = np.flatnonzero(np.diff(lost))  # a lost one tells nothing of the next
    assert len(runs) == pytest.approx(2 * share * (1 - share) * RAYS, rel=0.1, abs=1)


def seen(stage, *geoms, rays=RAYS, then=()):
    """What rays straight ahead return of some geoms."""
    model = model_of(*geoms)
    engine = AnalyticEngine.of(model)
    scan = cast(engine, ahead(rays), LEVEL)
    return observed(scan, engine, stage, *then, albedo=albedo_of(model))


@pytest.mark.parametrize("turn_deg", [0, 60])
def test_intensity_is_albedo_times_cosine(turn_deg):
    expected = 0.4 * math.cos(math.radians(turn_deg))
    assert_allclose(seen(Intensity(), wall(turn_deg), rays=9).intensity, expected, atol=1e-6)
    noisy = seen(Intensity(sigma=0.01), wall(turn_deg)).intensity[0]
    assert is_normal((noisy - expected) / 0.01)
    left = seen(Intensity(), wall(0), rays=99, then=[Dropout(share=0.5)])
    assert_array_equal(left.intensity > 0, np.isfinite(left.ranges))


@pytest.mark.parametrize("at_m", [10.0, np.inf])
def test_spurious_returns_are_even_along_the_way(at_m):
    ranges = applied(Spurious(share=0.3), np.full(RAYS, at_m))
    chosen = ranges != at_m
    assert as_often(chosen, 0.3)
    assert stats.kstest(ranges[chosen] / min(at_m, REACH_M), "uniform").pvalue > 0.01


WALLS = ("1 20", "11 0"), ("1 20", "-11 0"), ("20 1", "0 11"), ("20 1", "0 -11")


def over_edge(covered, rays=10, **options):
    """What a wide cone returns of a wall at 20 m, and one at 10 m whose upper edge stands `covered`
    m above the axis."""
    far = 'type="box" size="0.5 60 60" pos="20.5 0 0"'
    near = f'type="box" size="0.01 60 30" pos="10.01 0 {covered - 30}"'
    return seen(Divergence(mrad=10, **options), far, near, rays=rays).ranges


def test_a_cone_over_an_edge_returns_both_ranges():
    assert_allclose(over_edge(0.0, returns="first"), 10.0, atol=1e-3)
    assert_allclose(over_edge(0.0, returns="last"), 20.0, atol=1e-3)
    dual = over_edge(0.0, returns="dual", rays=20)
    assert dual.shape == (2, 20)
    both = np.sort(dual[:, np.isfinite(dual[1])], axis=0)
    assert both.size
    assert_allclose(both - [[10.0], [20.0]], 0.0, atol=1e-3)


@pytest.mark.parametrize("aside", [-0.02, 0.01])
def test_a_mixed_range_is_the_mean_by_area(aside):
    """A chord cuts a disk of radius 0.05 at 10 m."""
    x = aside / 0.05
    near = 0.5 + (x * math.sqrt(1 - x * x) + math.asin(x)) / math.pi
    mixed = over_edge(aside, resolution_m=50)
    assert mixed.mean() == pytest.approx(10 * near + 20 * (1 - near), abs=0.1)


def test_the_strongest_echo_is_the_one_of_most_light():
    assert_allclose(over_edge(-0.02), 20.0, atol=1e-3)
    assert_allclose(over_edge(0.02), 10.0, atol=1e-3)
    alone = seen(Divergence(mrad=10, returns="dual"), wall(0), rays=5)
    assert np.isinf(alone.ranges[1]).all()
    assert np.isinf(seen(Divergence(mrad=10), rays=5).ranges).all()


ROOM = [f'type="box" size="{size} 5" pos="{place} 0"' for size, place in WALLS]


@pytest.mark.parametrize("turned", [0.0, 200.0])
def test_a_corrected_scan_lies_on_the_walls(turned):
    """The room is 20 m wide: a point on a wall has 10 m for its greater coordinate. An uncorrected
    scan bends."""
    engine = MujocoEngine.of(model_of(*ROOM))
    motion = Motion(forward_mps=8.0, left_mps=-2.0, yaw_rate_deg_s=turned, poses=400)
    share = np.arange(200) / 200  # a horizontal turn, one ray after the other
    angle = 2 * math.pi * share
    rays = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle, 0.1 * share])
    sensor = BeamTable(rays=rays, max_range_m=REACH_M)
    scan = cast(engine, sensor, Pose.level((1.0, -2.0, 0.5), yaw_rad=0.4))

    def off(stage):
        points = observed(scan, engine, stage).points()
        return np.abs(np.abs(points[:, :2]).max(axis=1) - 10.0).max()

    assert off(dataclasses.replace(motion, corrected=True)) < 1e-6
    assert off(motion) > 0.2
    assert off(Motion(forward_mps=0.0)) < 1e-5


def test_a_stage_that_asks_for_surfaces_needs_an_engine_that_knows_them():
    engine = MujocoEngine.of(model_of(wall(0)))
    refuses("grazing", observed, cast(engine, ahead(3), LEVEL), engine, Grazing())
