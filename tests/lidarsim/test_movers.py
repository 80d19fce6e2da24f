"""Movers against a second code: numpy's polynomials, MuJoCo's mocap bodies, and time slices."""

import math

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import AnalyticEngine, MujocoEngine
from lidarsim.movers import Movers, MovingCaster
from lidarsim.solids import BOX, CAPSULE, ELLIPSOID, bounding_boxes

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
        offset=np.array([[0, 0, 0.9], [0, 0, 0.6], [-0.2, 0, 1.3], [0, 0, 0]]),
        piece_start=np.array([0, 4, 8, 12]),
        begin_s=np.tile(np.arange(4) * 2.0, 3),
        course=course,
        period_s=PERIOD_S,
    )


def random_rays(count, seed):
    rays = np.random.default_rng(seed).normal(size=(1, count, 3))
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


@pytest.mark.parametrize("time_s", [0.0, 1.999, 2.0, 7.3, 8.0, -0.5, 1000.7])
def test_poses_are_the_polynomials_values(time_s):
    movers = three_movers()
    position, heading, velocity, turn = movers.poses(time_s)
    since = time_s % PERIOD_S
    piece = int(since // 2.0)
    for m in range(3):
        channels = [np.poly1d(c[::-1]) for c in movers.course[4 * m + piece]]
        values = np.array([channel(since - 2.0 * piece) for channel in channels])
        slopes = np.array([channel.deriv()(since - 2.0 * piece) for channel in channels])
        assert_allclose(position[m], values[:3], atol=1e-12)
        assert_allclose(heading[m], values[3:] / np.hypot(*values[3:]), atol=1e-12)
        assert_allclose(velocity[m], slopes[:3], atol=1e-12)
        # the derivative of the angle of the heading
        cross = values[3] * slopes[4] - values[4] * slopes[3]
        assert_allclose(turn[m], cross / (values[3:] @ values[3:]), atol=1e-12)


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
    movers = three_movers()
    spec = mujoco.MjSpec.from_string(STANDING)
    standing = spec.compile()
    movers.add_to(spec, time_s)
    model = spec.compile()
    caster = MovingCaster(AnalyticEngine.of(standing), movers, time_s)
    origin, rays = np.array([[0.5, -3.0, 3.5]]), random_rays(4000, 2)
    ranges = caster.cast(origin, rays, 20.0)
    expected = MujocoEngine.of(model).cast(origin, rays, 20.0)
    assert_allclose(np.minimum(ranges, 20.0), np.minimum(expected, 20.0), atol=1e-6)
    assert np.count_nonzero(caster.solid_of(origin, rays, 20.0) >= 0) > 50


def test_each_ray_meets_movers_at_its_own_time():
    movers, standing = three_movers(), AnalyticEngine.of(mujoco.MjModel.from_xml_string(STANDING))
    origin, rays = np.array([[0.5, -3.0, 3.5]]), random_rays(3000, 3)
    times_s = np.random.default_rng(4).uniform(1.0, 3.0, 3000)
    together = MovingCaster(standing, movers, times_s).cast(origin, rays, 20.0)[0]
    single = [
        MovingCaster(standing, movers, time_s).cast(origin, rays[:, [n]], 20.0)[0, 0]
        for n, time_s in enumerate(times_s.tolist())
    ]
    assert_array_equal(together, single)


def test_times_of_other_rays_are_refused():
    standing = AnalyticEngine.of(mujoco.MjModel.from_xml_string(STANDING))
    caster = MovingCaster(standing, three_movers(), np.zeros(7))
    with pytest.raises(ValueError, match="one each"):
        caster.cast([[0.0, 0.0, 3.0]], random_rays(8, 0), 20.0)


def test_hits_lie_on_the_surface_with_outward_normals():
    movers, standing = three_movers(), AnalyticEngine.of(mujoco.MjModel.from_xml_string(STANDING))
    caster = MovingCaster(standing, movers, 3.3, geoms=2)
    origin, rays = np.array([[0.5, -3.0, 3.5]]), random_rays(4000, 2)
    hits = caster.hits(origin, rays, 20.0)
    assert_array_equal(hits.ranges, caster.cast(origin, rays, 20.0))
    moving = hits.geoms >= 2
    assert_array_equal(hits.geoms[moving] - 2, caster.solid_of(origin, rays, 20.0)[moving])
    assert_allclose(
        hits.points[moving], origin[0] + hits.ranges[moving][:, None] * rays[moving], atol=1e-12
    )
    # a short step outward leaves the solid, one inward enters it
    solids = movers.solids(3.3)
    owners = hits.geoms[moving] - 2
    for sign, outside in ((1e-6, True), (-1e-6, False)):
        points = hits.points[moving] + sign * hits.normals[moving]
        local = np.einsum("nji,nj->ni", solids.rotation[owners], points - solids.position[owners])
        depth = np.array([surplus(movers, o, p) for o, p in zip(owners, local, strict=True)])
        assert ((depth > 0) == outside).all()


def surplus(movers, solid, point):
    """Above 0 outside a solid, below 0 inside, by the definition of its shape."""
    size = movers.size[solid]
    if movers.shape[solid] == BOX:
        return (np.abs(point) - size).max()
    if movers.shape[solid] == ELLIPSOID:
        return ((point / size) ** 2).sum() - 1.0
    return np.linalg.norm(point - [0, 0, np.clip(point[2], -size[1], size[1])]) - size[0]


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


def test_solids_stand_in_their_boxes():
    solids = three_movers().solids(5.0)
    low, high = bounding_boxes(solids.shape, solids.size, solids.position, solids.rotation)
    assert_array_equal(solids.lower, low)
    assert_array_equal(solids.upper, high)
    assert_allclose(np.linalg.det(solids.rotation), 1.0)
