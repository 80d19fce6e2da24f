"""Laws of a leaning body: the acceleration against finite differences, the attitude against scipy
and MuJoCo."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from lidarsim import Pose
from scenegen.worlds.flight import GRAVITY, Route, acceleration, leaning

PATH = np.loadtxt(["0 0 2", "3 0 2", "3 0 2", "3 4 3", "1 4 5", "1 4 1.5", "-4 2 2"])
SPEED, SETTLE = 2.5, 0.7


def turned(pose):
    return Rotation.from_quat(pose.quaternion, scalar_first=True)


def test_acceleration_is_the_second_derivative_of_the_smoothed_path():
    route = Route(PATH)
    step = 0.002
    time = np.arange(-3 * SETTLE, route.ends[-1] / SPEED + 3 * SETTLE, step)
    there = np.clip(time * SPEED, 0.0, route.ends[-1])  # it rests before and after
    places = np.column_stack([np.interp(there, route.ends, PATH[:, axis]) for axis in range(3)])
    window = np.maximum(0.0, 1.0 - np.abs(np.arange(-SETTLE, SETTLE + step / 2, step)) / SETTLE)
    smooth = np.column_stack(
        [np.convolve(places[:, axis], window / window.sum(), "same") for axis in range(3)]
    )
    expected = np.diff(smooth, 2, axis=0) / step**2
    most = 0.0
    for n in range(len(time) // 8, 7 * len(time) // 8, 50):
        found = acceleration(*route.turns, time[n] * SPEED, speed_mps=SPEED, settle_s=SETTLE)
        assert_allclose(found, expected[n - 1], atol=0.05)
        most = max(most, float(np.abs(found).max()))
    assert most > 3.0


def test_the_thrust_is_the_bodys_z_axis_and_the_heading_stays(rng):
    for _ in range(200):
        level, pull = Pose.level(rng.normal(size=3), rng.uniform(-3.1, 3.1)), rng.uniform(-4, 4, 3)
        lean = leaning(level, tuple(pull), max_deg=80.0)
        thrust = pull + np.array([0.0, 0.0, GRAVITY])
        assert_allclose(turned(lean).apply([0, 0, 1]), thrust / np.linalg.norm(thrust), atol=1e-12)
        righting = turned(level).inv() * turned(lean)
        assert (
            abs(righting.as_rotvec()[2]) < 1e-12
        )  # the shortest turn has no part about the vertical
        assert_array_equal(lean.position, level.position)


def test_the_lean_is_bounded_and_a_body_that_does_not_accelerate_is_level_to_the_bit(rng):
    for _ in range(200):
        level = Pose.facing(rng.normal(size=3), rng.normal(size=2))
        assert_array_equal(
            leaning(level, (0.0, 0.0, 0.0), max_deg=30.0).quaternion, level.quaternion
        )
        lean = leaning(level, tuple(rng.uniform(-300, 300, 3)), max_deg=30.0)
        up = turned(lean).apply([0, 0, 1])
        assert np.degrees(np.arccos(up[2])) <= 30.0 + 1e-6
    forward = leaning(Pose.level((0, 0, 0), 0.0), (3.0, 0.0, 0.0), max_deg=30.0)
    assert turned(forward).apply([1, 0, 0])[2] < 0.0  # to accelerate forward, the nose goes down
