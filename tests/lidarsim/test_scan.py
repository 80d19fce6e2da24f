"""What tells returns from what drivers write for rays without one."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from lidarsim.pose import rotate
from lidarsim.scan import are_returns, is_return

RNG = np.random.default_rng(0)
LOST = RNG.random(3000) < 0.33
POINTS = RNG.normal(size=(3000, 3)) * 8
POINTS /= np.minimum(1, np.linalg.norm(POINTS, axis=1) / 0.5)[:, None]  # 0.5 m away at least
TURN = np.array([0.8, 0.0, 0.36, 0.48])
ARM = np.array([0.4, -0.2, 1.2])


@pytest.mark.parametrize("mark", [0.0, np.nan, np.inf, -np.inf, 0.02, 1e7])
def test_marks_of_drivers_are_no_returns(mark):
    points = np.where(LOST[:, None], mark, POINTS)
    assert_array_equal(are_returns(points), ~LOST)


def test_marks_moved_into_another_frame_are_no_returns():
    marked = np.where(LOST[:, None], 0.0, POINTS)
    moved, sensors = rotate(TURN, marked) + ARM, RNG.normal(size=POINTS.shape) * 50
    left = np.where(LOST[:, None], 0.0, rotate(TURN, POINTS) + ARM)
    queries = (moved, ARM), (left, ARM), (marked + sensors, sensors)
    for query in ((moved,), *queries):  # first, whoever does not say where the sensor was
        assert_array_equal(are_returns(*query), ~LOST)


def test_two_echoes_alike_are_returns():
    assert are_returns(POINTS.repeat(2, axis=0)).all()
    assert are_returns(np.tile(POINTS[0], (19, 1))).all()


def test_ranges_below_the_minimum_are_no_returns():
    ranges = np.array([[0.0, 0.29, 0.3], [np.nan, np.inf, 1e6], [-1.0, 1e-9, 80.0]], np.float32)
    expected = [[0, 0, 1], [0, 0, 0], [0, 0, 1]]
    assert_array_equal(is_return(ranges, 0.3), expected)
    assert_array_equal(is_return(ranges, 0.0)[:, 1], [1, 0, 1])
