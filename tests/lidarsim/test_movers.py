"""Movers against a second code: numpy's polynomials, MuJoCo's mocap bodies, and time slices."""

import math
from functools import cache

import mujoco
import numpy as np
import pytest
from numpy.polynomial.polynomial import polyder, polyval
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import AnalyticEngine
from lidarsim.movers import Movers, MovingCaster
from lidarsim.solids import BOX, CAPSULE, ELLIPSOID, bounding_boxes
from tests.lidarsim.engines.test_laws import data_of, from_mujoco
from tests.lidarsim.reference import unit

STANDING = """<mujoco><worldbody><geom type="plane" size="0 0 1"/>
<geom type="box" size="1 1 2" pos="6 1 2"/></worldbody></mujoco>"""
PERIOD_S = 8.0


def three_movers(seed=0):
    """A person, a car with a cabin and a drone, each on a random course of four pieces."""
    rng = np.random.default_rng(seed)
    course = np.zeros((12, 5, 4))
    course[:, :3, :3] = rng.uniform(-1, 1, (12, 3, 3)) * [4.0, 1.0, 0.2]
    course[:, 2, 0] += 3.0
    for m in range(3):
        # places without jumps; the round ends where it began, by a straight last piece
        for piece in range(4 * m + 1, 4 * m + 4):
            before = course[piece - 1, :3]
            course[piece, :3, 0] = before @ [1.0, 2.0, 4.0, 8.0]
        last = course[4 * m + 3, :3]
        last[:, 1], last[:, 2] = (course[4 * m, :3, 0] - last[:, 0]) / 2.0, 0.0
    course[:, 3:] = rng.uniform(-1, 1, (12, 2, 4)) * [1.0, 0.05, 0.01, 0.001]
    course[:, 3, 0] += np.copysign(1.0, course[:, 3, 0])
    return Movers(
        kind=np.array([1, 2, 3]),
        owner=np.array([0, 1, 1, 2]),
        shape=np.array([CAPSULE, BOX, BOX, ELLIPSOID]),
        size=np.array([[0.3, 0.6, 0], [2.0, 0.9, 0.4], [1.0, 0.8, 0.3], [0.4, 0.4, 0.1]]),
        offset=np.array([[0, 0, 0.9], [0, 0, 0.6], [-0.2, 0.1, 1.3], [0, 0, 0]]),
        piece_start=np.array([0, 4, 8, 12]),
        begin_s=np.tile(np.arange(4) * 2.0, 3),
        course=course,
        period_s=PERIOD_S,
    )


@cache
def standing():
    return AnalyticEngine.of(mujoco.MjModel.from_xml_string(STANDING))


def caster_of(time_s):
    return MovingCaster(standing(), three_movers(), time_s, geoms=2)


def rays_of(count, seed):
    """What is cast: an origin, random unit vectors (1, count, 3), and a maximum range."""
    rays = np.random.default_rng(seed).normal(size=(1, count, 3))
    return np.array([[0.5, -3.0, 3.5]]), unit(rays), 20.0


@pytest.mark.parametrize("time_s", [0.0, 1.999, 2.0, 7.3, 8.0, -0.5, 1000.7])
def test_poses_are_the_polynomials_values(time_s):
    movers = three_movers()
    position, heading, velocity, turn = movers.poses(time_s)
    since = time_s % PERIOD_S
    piece = int(since // 2.0)
    powers = movers.course[piece::4].T  # of 5 channels of 3 movers
    values, slopes = (polyval(since - 2.0 * piece, c) for c in (powers, polyder(powers)))
    (x, y), (slope_x, slope_y) = values[3:], slopes[3:]
    assert_allclose(position.T, values[:3], atol=1e-12)
    assert_allclose(heading.T, values[3:] / np.hypot(x, y), atol=1e-12)
    assert_allclose(velocity.T, slopes[:3], atol=1e-12)
    # the derivative of the angle of the heading
    assert_allclose(turn, (x * slope_y - y * slope_x) / (x * x + y * y), atol=1e-12)


@pytest.mark.parametrize("span", [(0.25, 0.75), (1.5, 9.25), (100.0, 130.5)])
def test_a_window_has_the_same_bits(span):
    movers = three_movers()
    part = movers.window(*span)
    assert part.period_s == math.inf
    for time_s in np.random.default_rng(1).uniform(*span, 50).tolist():
        for whole, cut in zip(movers.poses(time_s), part.poses(time_s), strict=True):
            assert_array_equal(whole, cut)


@pytest.mark.parametrize("time_s", [0.4, 3.3, 6.1, 14.9])
def test_rays_agree_with_mocap_bodies(time_s):
    """Ranges, geoms, points and outward normals; and so do solids."""
    movers, spec = three_movers(), mujoco.MjSpec.from_string(STANDING)
    movers.add_to(spec, time_s)
    model = spec.compile()
    data = data_of(model)
    caster, (origin, rays, reach) = caster_of(time_s), rays_of(4000, 2)
    hits = caster.hits(origin, rays, reach)
    ranges, geoms, normals = from_mujoco(model, data, origin[0], rays[0], reach)
    assert_allclose(hits.ranges[0], ranges, atol=1e-6)
    assert_array_equal(hits.geoms[0], geoms)
    assert_allclose(hits.normals[0], normals, atol=1e-5)
    met, points = geoms >= 0, origin + hits.ranges[0, :, None] * rays[0]
    assert_allclose(hits.points[0, met], points[met], atol=1e-12)
    assert_array_equal(caster.cast(origin, rays, reach), hits.ranges)
    assert_array_equal(caster.solid_of(origin, rays, reach)[0], np.maximum(geoms - 2, -1))
    assert np.count_nonzero(geoms >= 2) > 50
    solids = movers.solids(time_s)
    assert_allclose(solids.position, data.geom_xpos[2:], atol=1e-12)
    assert_allclose(solids.rotation, data.geom_xmat[2:].reshape(-1, 3, 3), atol=1e-12)
    box = bounding_boxes(solids.shape, solids.size, solids.position, solids.rotation)
    assert_array_equal((solids.lower, solids.upper), box)


def test_each_ray_meets_movers_at_its_own_time():
    """Rays that aim beside where a mover then is."""
    rng, (origin, _, reach), movers = np.random.default_rng(4), rays_of(0, 0), three_movers()
    times_s = rng.uniform(1.0, 3.0, 600)
    places = [movers.poses(time_s)[0][n % 3] for n, time_s in enumerate(times_s.tolist())]
    rays = unit(places - origin + 0.4 * rng.normal(size=(600, 3)))[None]
    together = caster_of(times_s).hits(origin, rays, reach)
    single = [
        caster_of(time_s).hits(origin, rays[:, [n]], reach)
        for n, time_s in enumerate(times_s.tolist())
    ]
    for name in ("ranges", "geoms", "normals"):
        values = [getattr(hits, name)[0, 0] for hits in single]
        assert_array_equal(getattr(together, name)[0], values)
    assert np.count_nonzero(together.geoms >= 2) > 100
    with pytest.raises(ValueError, match="one each"):
        caster_of(times_s).cast(*rays_of(8, 0))


def test_balls_hold_movers_for_a_while():
    movers = three_movers()
    point = np.array([1.0, -2.0, 3.0])
    nearest = min(
        (np.linalg.norm(movers.poses(t)[0] - point, axis=1) - movers._radius).min()
        for t in np.linspace(1.7, 2.9, 2000)
    )
    bound = movers.distances_m(point[None], 1.7, 1.2)[0]
    # a part of the courses has fewer speeds, so its bound is no looser
    assert bound <= movers.window(1.0, 3.0).distances_m(point[None], 1.7, 1.2)[0] <= nearest
