"""Laws of the lidar's ray layout, of poses and of the grid's placement, against scipy rotations."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import Lidar, Pose
from lidarsim.pose import rotate
from tests.lidarsim import reference
from tests.refusals import refuses
from tests.scenegen import cases, each_case


@pytest.mark.parametrize("mount", ["tilt", "band"])
@each_case("../lidarsim/layouts", "rows columns vertical pitch", json.loads)
def test_every_ray_follows_the_layout(rows, columns, vertical, pitch, mount, rng):
    """At any attitude, against `reference.lidar_directions`: products of scipy rotations, restated
    from the specification. A single column looks straight ahead."""
    quaternion = reference.random_quaternion(rng)
    layout = {"rows": rows, "vertical_fov_deg": vertical, "pitch_deg": pitch, "mount": mount}
    rays = Lidar(columns=columns, **layout).directions_body
    expected = reference.lidar_directions(quaternion, columns=max(columns, 2), **layout)
    # of two columns, the second is at azimuth 0
    expected = expected[:, -columns:]
    assert_allclose(rotate(quaternion, rays), expected, rtol=0, atol=1e-14)


def test_a_horizontal_fov_below_a_full_turn_includes_both_its_ends():
    lidar = Lidar(rows=1, columns=4, horizontal_fov_deg=90.0, pitch_deg=0.0)
    x, y, _ = lidar.directions_body[0].T
    assert_allclose(np.degrees(np.arctan2(y, x)), [-45, -15, 15, 45], atol=1e-12)


def test_poses_are_turned_by_the_angle_they_face(rng):
    place = (1.0, -2.0, 3.5)
    plain = np.loadtxt(sum(cases("../lidarsim/headings"), ()))
    for x, y in [*plain, *rng.normal(size=(100, 2))]:
        angle = np.arctan2(y, x)
        turn = reference.Rotation.from_euler("z", angle).as_matrix()
        for pose in (Pose.facing(place, (x, y)), Pose.level(place, angle)):
            assert_array_equal(pose.position, place)
            actual = reference.rotation(pose.quaternion).as_matrix()
            assert_allclose(actual, turn, rtol=0, atol=1e-15)
    for nowhere in ((0.0, 0.0), (np.nan, 1.0), (np.inf, 0.0)):
        refuses(nowhere, Pose.facing, place, nowhere)


def test_a_bad_pose_is_refused_by_name():
    level = {"position": np.zeros(3), "quaternion": np.array([1.0, 0.0, 0.0, 0.0])}
    for name, wrong in (("position", np.nan), ("quaternion", 0.0), ("quaternion", np.nan)):
        refuses(f"{name} {wrong}", Pose, **level | {name: np.full_like(level[name], wrong)})
    refuses("three numbers", Pose, np.zeros(3), np.eye(3)[0])
