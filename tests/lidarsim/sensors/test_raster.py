"""Laws of the lidar's ray layout, of poses and of the grid's placement, against scipy rotations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lidarsim import GridSpec, Lidar, Pose
from lidarsim.pose import rotate
from tests.lidarsim import reference

LEVEL = (1.0, 0.0, 0.0, 0.0)


def elevation_deg(directions: np.ndarray) -> np.ndarray:
    """Angle above the horizon, by arctangent of height over ground distance."""
    return np.degrees(
        np.arctan2(directions[..., 2], np.hypot(directions[..., 0], directions[..., 1]))
    )


def azimuth_deg(directions: np.ndarray) -> np.ndarray:
    """Angle left of x in the ground plane."""
    return np.degrees(np.arctan2(directions[..., 1], directions[..., 0]))


def test_defaults_are_the_specified_sensor() -> None:
    lidar = Lidar()
    assert (lidar.rows, lidar.columns) == (16, 120)
    assert (lidar.vertical_fov_deg, lidar.horizontal_fov_deg, lidar.pitch_deg) == (60, 360, 30)
    assert (lidar.max_range_m, lidar.mount) == (10.0, "tilt")


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("mount", ["tilt", "band"])
def test_every_ray_follows_the_layout_at_any_attitude(seed: int, mount: str) -> None:
    """Against `reference.lidar_directions`: products of scipy rotations, restated from the
    specification."""
    quaternion = reference.random_quaternion(np.random.default_rng(seed))
    got = rotate(quaternion, Lidar(mount=mount).directions_body)
    assert got.shape == (16, 120, 3)
    assert got.dtype == np.float64
    np.testing.assert_allclose(
        got, reference.lidar_directions(quaternion, mount=mount), rtol=0, atol=1e-14
    )


@pytest.mark.parametrize("mount", ["tilt", "band"])
@pytest.mark.parametrize(
    ("rows", "columns", "vertical", "pitch"),
    [(2, 1, 10.0, 0.0), (5, 7, 33.0, 12.5), (32, 9, 90.0, -20.0), (3, 360, 0.5, 90.0)],
)
def test_other_sizes_spread_rows_over_the_fov_ends_included_and_columns_over_the_turn(
    rows: int, columns: int, vertical: float, pitch: float, mount: str
) -> None:
    """A single column looks straight ahead; apart from that, the specification's angles for any
    counts."""
    quaternion = reference.random_quaternion(np.random.default_rng(rows))
    lidar = Lidar(
        rows=rows, columns=columns, vertical_fov_deg=vertical, pitch_deg=pitch, mount=mount
    )
    expected = reference.lidar_directions(
        quaternion,
        rows=rows,
        columns=max(columns, 2),
        vertical_fov_deg=vertical,
        pitch_deg=pitch,
        mount=mount,
    )
    expected = (
        expected if columns > 1 else expected[:, 1:]
    )  # of two columns, the second is at azimuth 0
    np.testing.assert_allclose(
        rotate(quaternion, lidar.directions_body), expected, rtol=0, atol=1e-14
    )


def test_a_horizontal_fov_below_a_full_turn_includes_both_its_ends() -> None:
    lidar = Lidar(rows=1, columns=4, horizontal_fov_deg=90.0, pitch_deg=0.0)
    np.testing.assert_allclose(
        azimuth_deg(rotate(LEVEL, lidar.directions_body))[0], [-45, -15, 15, 45], atol=1e-12
    )


def test_a_single_row_is_the_sensors_horizon() -> None:
    lidar = Lidar(rows=1, columns=8, pitch_deg=0.0)
    np.testing.assert_allclose(elevation_deg(rotate(LEVEL, lidar.directions_body)), 0.0, atol=1e-12)


@pytest.mark.parametrize("mount", ["tilt", "band"])
@pytest.mark.parametrize("seed", range(5))
def test_directions_are_unit_vectors(seed: int, mount: str) -> None:
    quaternion = reference.random_quaternion(np.random.default_rng(seed))
    lengths = np.linalg.norm(rotate(quaternion, Lidar(mount=mount).directions_body), axis=-1)
    np.testing.assert_allclose(lengths, 1.0, rtol=0, atol=1e-14)


def test_directions_are_unit_vectors_for_an_attitude_rounded_to_float32() -> None:
    """An attitude that a Pose accepts gives rays along which a range is in metres, to the last
    micrometre."""
    for seed in range(20):
        rounded = reference.random_quaternion(np.random.default_rng(seed)).astype(np.float32)
        pose = Pose(position=np.zeros(3), quaternion=rounded.astype(np.float64))
        lengths = np.linalg.norm(rotate(pose.quaternion, Lidar().directions_body), axis=-1)
        np.testing.assert_allclose(lengths, 1.0, rtol=0, atol=1e-9)


def test_forward_rays_cover_minus_60_to_0_degrees_and_rear_rays_0_to_60() -> None:
    """The tilted sensor looks down in front and up behind: the specification's picture of the
    layout."""
    directions = rotate(LEVEL, Lidar().directions_body)
    forward, rear = directions[:, 60], directions[:, 0]
    np.testing.assert_allclose(elevation_deg(forward), np.linspace(-60, 0, 16), atol=1e-10)
    np.testing.assert_allclose(elevation_deg(rear), np.linspace(60, 0, 16)[::-1], atol=1e-10)
    assert np.all(forward[:, 0] > 0.49)
    assert np.all(rear[:, 0] < -0.49)
    np.testing.assert_allclose(directions[:, [0, 60], 1], 0.0, atol=1e-15)


def test_columns_turn_counter_clockwise_from_the_rear() -> None:
    """Column 30 is at -90 degrees, on the right (y negative), column 90 on the left."""
    directions = rotate(LEVEL, Lidar(pitch_deg=0.0).directions_body)
    np.testing.assert_allclose(directions[:, 30, 0], 0.0, atol=1e-15)
    assert np.all(directions[:, 30, 1] < -0.86)
    assert np.all(directions[:, 90, 1] > 0.86)


def test_band_mount_has_the_same_elevations_in_every_column() -> None:
    directions = rotate(LEVEL, Lidar(mount="band").directions_body)
    expected = np.broadcast_to(np.linspace(-60, 0, 16)[:, None], (16, 120))
    np.testing.assert_allclose(elevation_deg(directions), expected, atol=1e-10)
    azimuths = np.tile(np.arange(-177, 180, 3), (16, 1))
    np.testing.assert_allclose(azimuth_deg(directions[:, 1:]), azimuths, atol=1e-10)


def test_mounts_agree_without_pitch_and_differ_with_it() -> None:
    level = [
        rotate(LEVEL, Lidar(mount=mount, pitch_deg=0.0).directions_body)
        for mount in ("tilt", "band")
    ]
    np.testing.assert_allclose(level[0], level[1], rtol=0, atol=1e-15)
    pitched = [rotate(LEVEL, Lidar(mount=mount).directions_body) for mount in ("tilt", "band")]
    assert np.abs(pitched[0] - pitched[1]).max() > 0.8


@settings(max_examples=25, deadline=None, derandomize=True)
@given(yaw=st.floats(-10, 10))
def test_yaw_turns_every_ray_about_the_vertical(yaw: float) -> None:
    turned = rotate(Pose.level((1.0, 2.0, 3.0), yaw).quaternion, Lidar().directions_body)
    c, s = np.cos(yaw), np.sin(yaw)
    expected = (
        rotate(LEVEL, Lidar().directions_body)
        @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    )
    np.testing.assert_allclose(turned, expected, rtol=0, atol=1e-13)


def test_the_attitude_is_applied_after_the_mounting() -> None:
    """A sensor nose down on a body rolled 90 degrees about x looks to the side that was down: its
    left."""
    roll = Rotation.from_euler("x", 90, degrees=True).as_quat()[[3, 0, 1, 2]]
    centre = rotate(roll, Lidar(rows=3, columns=2).directions_body)[1, 1]
    np.testing.assert_allclose(centre, [np.sqrt(3) / 2, 0.5, 0.0], atol=1e-12)


def test_level_pose_holds_its_position_and_turns_x_to_the_yaw() -> None:
    for yaw in (-3.0, 0.0, 0.3, np.pi / 2):
        pose = Pose.level((1.0, -2.0, 3.5), yaw)
        np.testing.assert_array_equal(pose.position, [1.0, -2.0, 3.5])
        matrix = reference.rotation(pose.quaternion).as_matrix()
        np.testing.assert_allclose(matrix @ [1, 0, 0], [np.cos(yaw), np.sin(yaw), 0], atol=1e-15)
        np.testing.assert_allclose(matrix @ [0, 0, 1], [0, 0, 1], atol=1e-15)


def test_facing_a_direction_is_a_turn_by_its_angle() -> None:
    rng = np.random.default_rng(6)
    plain = [
        (1, 0),
        (0, 1),
        (-1, 0),
        (0, -1),
        (-1, -1e-300),
        (-1, 1e-9),
        (1e-9, -1),
        (3e-5, 4e-5),
        (-6e80, -8e80),
    ]
    for x, y in [*plain, *rng.normal(size=(500, 2)).tolist()]:
        pose = Pose.facing((1.0, -2.0, 3.5), (x, y))
        expected = Pose.level((1.0, -2.0, 3.5), np.arctan2(y, x))
        np.testing.assert_array_equal(pose.position, expected.position)
        np.testing.assert_allclose(pose.quaternion, expected.quaternion, rtol=0, atol=3e-16)
    for nowhere in ((0.0, 0.0), (np.nan, 1.0), (np.inf, 0.0)):
        with pytest.raises(ValueError, match="direction"):
            Pose.facing((0.0, 0.0, 0.0), nowhere)


def test_a_quaternion_and_its_negative_are_one_attitude() -> None:
    quaternion = reference.random_quaternion(np.random.default_rng(5))
    one, other = (
        rotate(quaternion, Lidar().directions_body),
        rotate(-quaternion, Lidar().directions_body),
    )
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("rows", 0),
        ("rows", -3),
        ("rows", 2.5),
        ("rows", float("nan")),
        ("rows", float("inf")),
        ("columns", 0),
        ("columns", -1),
        ("vertical_fov_deg", -1.0),
        ("vertical_fov_deg", 361.0),
        ("vertical_fov_deg", float("nan")),
        ("horizontal_fov_deg", -1.0),
        ("horizontal_fov_deg", 360.5),
        ("pitch_deg", float("nan")),
        ("max_range_m", -1.0),
        ("max_range_m", 0.0),
        ("max_range_m", float("nan")),
        ("max_range_m", float("inf")),
        ("mount", "gimbal"),
    ],
)
def test_a_bad_lidar_parameter_is_refused_by_name(parameter: str, value: object) -> None:
    with pytest.raises(ValueError, match=parameter):
        Lidar(**{parameter: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("shape", (80, 80)),
        ("shape", (80, 80, 0)),
        ("shape", (80, -1, 40)),
        ("shape", (80, 80, 40.5)),
        ("voxel_m", 0.0),
        ("voxel_m", -0.2),
        ("voxel_m", float("nan")),
        ("truncation_m", 0.0),
    ],
)
def test_a_bad_grid_parameter_is_refused_by_name(parameter: str, value: object) -> None:
    with pytest.raises(ValueError, match=parameter):
        GridSpec(**{parameter: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("position", "quaternion", "named"),
    [
        ((0.0, 0.0), LEVEL, "position"),
        ((0.0, 0.0, float("nan")), LEVEL, "position"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), "quaternion"),
        ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), "quaternion"),
    ],
)
def test_a_bad_pose_is_refused_by_name(
    position: tuple[float, ...], quaternion: tuple[float, ...], named: str
) -> None:
    with pytest.raises(ValueError, match=named):
        Pose(position=np.array(position), quaternion=np.array(quaternion))


def test_settings_and_poses_cannot_be_changed_after_the_check() -> None:
    for value, name in (
        (Lidar(), "rows"),
        (GridSpec(), "voxel_m"),
        (Pose.level((0, 0, 0)), "position"),
    ):
        with pytest.raises(AttributeError):
            setattr(value, name, 1)


@pytest.mark.parametrize(
    ("shape", "voxel"), [((80, 80, 40), 0.2), ((3, 4, 5), 0.25), ((1, 1, 1), 7.0)]
)
def test_the_grid_is_centred_on_the_position(shape: tuple[int, int, int], voxel: float) -> None:
    grid = GridSpec(shape=shape, voxel_m=voxel)
    position = np.array([3.25, -7.5, 1.125])
    np.testing.assert_allclose(grid.extent_m, np.array(shape) * voxel, rtol=1e-15)
    origin = grid.origin_at(position)
    assert origin.dtype == np.float64
    np.testing.assert_allclose(position - origin, np.array(shape) * voxel / 2, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(origin, position - grid.extent_m / 2)
