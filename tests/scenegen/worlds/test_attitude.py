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


def test_acceleration_is_that_of_the_smoothed_path():
    """The second derivative, by finite differences."""
    route, step = Route(PATH), 0.002
    time = np.arange(-3 * SETTLE, route.ends[-1] / SPEED + 3 * SETTLE, step)
    flown = np.clip(time * SPEED, 0.0, route.ends[-1])  # it rests before and after
    window = np.maximum(0.0, 1.0 - np.abs(np.arange(-SETTLE, SETTLE + step / 2, step)) / SETTLE)
    smooth = [
        np.convolve(np.interp(flown, route.ends, along), window / window.sum(), "same")
        for along in PATH.T
    ]
    expected = np.diff(smooth, 2, axis=1).T / step**2
    chosen = range(len(time) // 8, 7 * len(time) // 8, 50)
    actual = [
        acceleration(*route.turns, time[n] * SPEED, speed_mps=SPEED, settle_s=SETTLE)
        for n in chosen
    ]
    assert_allclose(actual, expected[np.subtract(chosen, 1)], atol=0.05)
    assert np.abs(actual).max() > 3.0


def test_the_thrust_is_the_bodys_z_axis(rng):
    """And the heading stays; the lean is bounded, and who does not accelerate is level to the
    bit."""
    for _ in range(200):
        level, pull = Pose.level(rng.normal(size=3), rng.uniform(-3.1, 3.1)), rng.uniform(-4, 4, 3)
        lean = leaning(level, tuple(pull), max_deg=80.0)
        up = turned(lean).apply([0, 0, 1])
        assert_allclose(np.cross(up, np.add(pull, [0, 0, GRAVITY])), 0, atol=1e-11)
        assert up[2] > 0
        righting = (turned(level).inv() * turned(lean)).as_rotvec()
        assert abs(righting[2]) < 1e-12  # the shortest turn has no part about the vertical
        assert_array_equal(lean.position, level.position)
        bounded = leaning(level, tuple(75 * pull), max_deg=30.0)
        assert turned(bounded).apply([0, 0, 1])[2] >= np.cos(np.radians(30.0 + 1e-6))
        still = leaning(level, (0.0, 0.0, 0.0), max_deg=30.0)
        assert_array_equal(still.quaternion, level.quaternion)


def test_to_accelerate_forward_the_nose_goes_down():
    forward = leaning(Pose.level((0, 0, 0), 0.0), (3.0, 0.0, 0.0), max_deg=30.0)
    assert turned(forward).apply([1, 0, 0])[2] < 0.0
