"""Every sensor of the catalogue against figures of its document, measured on its rays; and sensors
that cannot be."""

import dataclasses
import json
import math
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import BeamTable, MujocoEngine, Pose, attach, cast
from lidarsim.sensors import CATALOGUE, FAMILIES, SENSORS, device
from lidarsim.sensors.raster import Pinhole
from lidarsim.sensors.spinning import Rosette, Spinning
from tests.command_line import rows
from tests.lidarsim.engines.test_laws import model_of
from tests.refusals import refuses

named = cache(SENSORS.find)
DOCUMENTS = rows(Path(__file__).with_name("documents.txt").read_text(encoding="utf-8"))
"""Of each document: beams, lowest and highest beam in degrees, degrees from column to column at
10 Hz, points a second, range in metres."""
SPINNING = {name: list(map(float, figures)) for name, *figures in DOCUMENTS}


def angles_deg(sensor):
    """Elevation and azimuth of every ray."""
    x, y, z = np.moveaxis(sensor.directions_body, -1, 0)
    return np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, x))


def test_angles_do_not_hang_on_the_last_bit_of_an_arctangent(monkeypatch):
    """Other processors have another one: a figure halfway between two steps was printed either
    way."""
    tie = Spinning(elevations_deg=(-11.25, 0.005, 33.335), columns=16)
    told, true = device.angles_deg(tie.directions_body), np.arctan2
    assert_array_equal(told[0], np.repeat(np.array(tie.elevations_deg)[:, None], 16, axis=1))
    assert_allclose(told, angles_deg(tie), atol=1e-9)
    for way in (-math.inf, math.inf):
        monkeypatch.setattr(np, "arctan2", lambda y, x, way=way: np.nextafter(true(y, x), way))
        assert_array_equal(device.angles_deg(tie.directions_body), told)


def test_the_registry_and_the_catalogue_hold_the_same_sensors():
    assert set(SENSORS.builtin) == set(FAMILIES) | set(CATALOGUE)
    assert {name for name in CATALOGUE if isinstance(named(name), Spinning)} == set(SPINNING)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_sensor_has_unit_rays_rising_times_and_a_source(name):
    sensor = named(name)
    assert sensor.name == name
    assert min(len(sensor.source), len(sensor.checked), len(sensor.error)) > 20
    table = BeamTable.of(sensor)
    assert (table.shape, table.made_by) == (sensor.shape, name)
    assert sensor.times_s.min() >= 0
    assert (np.diff(sensor.times_s, axis=-1) >= 0).all()
    assert 0 <= sensor.min_range_m < sensor.max_range_m
    rays = sensor.directions_body.reshape(-1, 3)
    different = len(np.unique(rays @ (1.0, 1e3, 1e6)))
    assert different > 0.999 * len(rays)  # hardly two look the same way


@pytest.mark.parametrize("name", SPINNING)
def test_a_spinning_sensors_rays_are_as_documented(name):
    beams, low, high, step_deg, points_hz, range_m = SPINNING[name]
    sensor = named(name)
    elevation, azimuth = angles_deg(sensor)
    assert (sensor.shape[0], sensor.max_range_m) == (beams, range_m)
    assert (elevation.min(), elevation.max()) == pytest.approx((low, high), abs=0.01)
    assert np.ptp(elevation, axis=1).max() < 1e-9  # a beam keeps its elevation
    assert len(np.unique(elevation[:, 0].round(6))) == beams
    steps = np.diff(np.unwrap(np.radians(azimuth), axis=1), axis=1)
    assert_allclose(np.degrees(steps), -step_deg, rtol=2e-3)  # clockwise from above
    assert_allclose(steps.sum(axis=1), -2 * math.pi, rtol=5e-3)  # a turn, but for its last column
    assert elevation.size * sensor.rate_hz == pytest.approx(points_hz, rel=3e-3)
    assert sensor.times_s.max() < 1 / sensor.rate_hz


STAGGERED = """
ouster-os0-32  →  31 → -46.26       → -11.35
ouster-os1-128 →  64 →  -0.64       →   4.22
ouster-os1-64  →   0 →  20.67       →   1.41
ouster-os2-128 → 127 → -11.09       →  -2.04
hesai-qt-128   →   0 → -52.62676282 →  10.10830596
hesai-qt-128   →  96 →  19.19081372 →  -6.25017485
"""


@pytest.mark.parametrize(("name", "row", "elevation", "azimuth"), rows(STAGGERED))
def test_staggered_beams_point_where_the_makers_drivers_place_them(name, row, elevation, azimuth):
    """Ouster's own formula, and Hesai's: column c at 2π c / columns, azimuths clockwise, begun at
    the rear."""
    sensor, row = named(name), int(row)
    turned = 360 / sensor.shape[1] * np.arange(sensor.shape[1]) + 360 * 10 * sensor.times_s[row, 0]
    around, up = np.radians(180 - turned - float(azimuth)), math.radians(float(elevation))
    level, high = math.cos(up), np.full_like(around, math.sin(up))
    expected = np.stack([level * np.cos(around), level * np.sin(around), high], axis=-1)
    assert_allclose(sensor.directions_body[row], expected, atol=2e-5)


@pytest.mark.parametrize(
    ("name", "firing", "begin_us", "gap_us"),
    [("velodyne-vlp-16", [-15, 1, -13, 3], 0, 2.304), ("hesai-xt-32", [15, 14, 13], 0.368, 1.512)],
)
def test_beams_fire_in_the_documented_order_while_the_head_turns(name, firing, begin_us, gap_us):
    sensor = named(name)
    elevation, azimuth = angles_deg(sensor)
    order = np.argsort(sensor.times_s[:, 0])
    assert elevation[order, 0][: len(firing)] == pytest.approx(firing)
    assert_allclose(np.diff(sensor.times_s[order, 0]), gap_us * 1e-6)
    assert sensor.times_s.min() == pytest.approx(begin_us * 1e-6)
    turned = np.unwrap(np.radians(azimuth[order, 5]))
    assert_allclose(np.diff(turned), -2 * math.pi * 10 * gap_us * 1e-6, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "points_hz", "up"),
    [("livox-mid-360", 2e5, (-7, 52)), ("livox-avia", 2.4e5, (-38.6, 38.6))],
)
def test_a_pattern_keeps_to_its_field_of_view_and_does_not_repeat(name, points_hz, up):
    sensor = named(name)
    elevation, azimuth = angles_deg(sensor)
    assert sensor.shape == (points_hz / 10,)
    assert sensor.times_s[-1] == pytest.approx(0.1, rel=1e-3)
    assert (elevation.min(), elevation.max()) == pytest.approx(up, abs=0.5)
    assert up[0] - 1e-9 <= elevation.min() <= elevation.max() <= up[1] + 1e-9
    wide = 35.2 if name == "livox-avia" else 180
    assert wide - 0.5 < np.abs(azimuth).max() <= wide + 1e-9

    def cells(seed, window_s):
        angles = angles_deg(dataclasses.replace(sensor, seed=seed, window_s=window_s))
        return set(map(tuple, np.floor(angles).T.tolist()))

    one, other = cells(1, 0.02), cells(2, 0.02)
    assert len(one & other) < 0.8 * len(one)
    assert one < cells(1, 0.1)


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_rosette_fills_the_ring_between_the_difference_and_the_sum_of_its_prisms(share):
    half = math.radians(20)
    rosette = Rosette(horizontal_fov_deg=40, vertical_fov_deg=40, second_share=share, window_s=0.4)
    away = np.arccos(np.clip(rosette.directions_body[:, 0], -1, 1))
    assert away.max() == pytest.approx(half, rel=1e-3)
    assert away.min() == pytest.approx((1 - 2 * share) * half, abs=1e-3)


@pytest.mark.parametrize("name", ["realsense-d435", "realsense-d455"])
def test_a_depth_cameras_rays_meet_a_plane_in_a_square_grid(name):
    sensor = named(name)
    assert isinstance(sensor, Pinhole)
    picture = sensor.directions_body[..., 1:] / sensor.directions_body[..., :1]
    across, down = -np.diff(picture[..., 0], axis=1), -np.diff(picture[..., 1], axis=0)
    assert_allclose(across, across[0, 0])
    assert_allclose(down, down[0, 0])
    # half a pixel lies beyond the outermost rays
    assert 2 * math.degrees(math.atan(picture[0, 0, 0] + across[0, 0] / 2)) == pytest.approx(87)
    assert 2 * math.degrees(math.atan(picture[0, 0, 1] + down[0, 0] / 2)) == pytest.approx(58)
    assert_allclose(picture, -picture[::-1, ::-1], atol=1e-12)


def test_a_lever_arm_moves_the_origin_of_the_rays_with_the_body():
    """At a yaw of 90° the body's x axis is the world's y axis."""
    sensor = Spinning(elevations_deg=(0.0,), columns=4, lever_arm_m=(0.5, 0.0, 0.2))
    model, pose = model_of('size="1" pos="1 7 3.2"'), Pose.level((1.0, 2.0, 3.0), math.pi / 2)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    on_world = attach(model, "world", sensor, offset=pose, unseen="nothing")
    for scan in (cast(MujocoEngine.of(model), sensor, pose), on_world.scan(data)):
        assert scan.pose.position == pytest.approx([1.0, 2.5, 3.2])
        assert scan.points() == pytest.approx(np.array([[1.0, 6.0, 3.2]]))


IMPOSSIBLE = """
spinning → {"columns": 8, "elevations_deg": []}
spinning → {"columns": 8, "elevations_deg": [0, 1], "min_range_m": 200}
spinning → {"elevations_deg": [0, 1]}
spinning → {"columns": 8, "elevations_deg": [0, 1, 1]}
spinning → {"columns": 8, "elevations_deg": [0, 1], "azimuth_offsets_deg": [0.5]}
spinning → {"columns": 8, "elevations_deg": [-0.05, -0.02, 0.02, 0.05]}
spinning → {"columns": 8, "elevations_deg": [0, 1], "firing_times_s": [0.0, 0.5]}
spinning → {"columns": 1000000, "elevations_deg": [0, 1]}
pinhole  → {"vertical_fov_deg": 1.0}
coil     → {"lowest_deg": -0.12, "highest_deg": 0.9}
rosette  → {"window_s": 1e-9}
pinhole  → {"name": "a\\nb"}
"""


@pytest.mark.parametrize(("family", "values"), rows(IMPOSSIBLE))
def test_an_impossible_sensor_is_refused(family, values):
    refuses(f"{family} {values}", named(family), **json.loads(values))
