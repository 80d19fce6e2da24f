"""Every sensor of the catalogue against figures of its document, measured on its rays; and sensors
that cannot be."""

import dataclasses
import json
import math
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import BeamTable, MujocoEngine, Pose, attach, cast
from lidarsim.sensors import CATALOGUE, FAMILIES, SENSORS, device
from lidarsim.sensors.raster import Pinhole
from lidarsim.sensors.spinning import Spinning
from tests.command_line import beside, rows
from tests.lidarsim.engines.test_laws import data_of, model_of
from tests.refusals import refuses
from tests.scenegen import each_case

named = cache(SENSORS.find)
DOCUMENTS = rows(beside(__file__, "documents.txt"))
"""Of each document: beams, lowest and highest beam in degrees, degrees from column to column at
10 Hz, points a second, range in metres."""
SPINNING = {name: list(map(float, figures)) for name, *figures in DOCUMENTS}


def angles_deg(sensor):
    """Elevation and azimuth of every ray."""
    x, y, z = np.moveaxis(sensor.directions_body, -1, 0)
    return np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, x))


def test_angles_ignore_an_arctangents_last_bit(monkeypatch):
    """Other processors have another one: a figure halfway between two steps was printed either
    way."""
    tie, true = Spinning(elevations_deg=(-11.25, 0.005, 33.335), columns=16), np.arctan2
    angles = device.angles_deg(tie.directions_body)
    assert_array_equal(angles[0].T, np.tile(tie.elevations_deg, (16, 1)))
    assert_allclose(angles, angles_deg(tie), atol=1e-9)
    for way in (-math.inf, math.inf):
        monkeypatch.setattr(np, "arctan2", lambda y, x, way=way: np.nextafter(true(y, x), way))
        assert_array_equal(device.angles_deg(tie.directions_body), angles)


def test_the_registry_and_the_catalogue_hold_the_same_sensors():
    assert set(SENSORS.builtin) == set(FAMILIES) | set(CATALOGUE)
    assert {name for name in CATALOGUE if isinstance(named(name), Spinning)} == set(SPINNING)


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_sensor_has_unit_rays_rising_times_and_a_source(name):
    sensor = named(name)
    assert sensor.name == name
    assert min(len(sensor.source), len(sensor.checked), len(sensor.error)) > 20
    table = BeamTable.of(sensor)
    assert table.shape == sensor.shape
    assert table.made_by == name
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
    assert sensor.shape[0] == beams
    assert sensor.max_range_m == range_m
    assert (elevation.min(), elevation.max()) == pytest.approx((low, high), abs=0.01)
    assert np.ptp(elevation, axis=1).max() < 1e-9  # a beam keeps its elevation
    assert len(np.unique(elevation[:, 0].round(6))) == beams
    steps = np.diff(np.unwrap(np.radians(azimuth), axis=1), axis=1)
    assert_allclose(np.degrees(steps), -step_deg, rtol=2e-3)  # clockwise from above
    assert_allclose(steps.sum(axis=1), -2 * math.pi, rtol=5e-3)  # a turn, but for its last column
    assert elevation.size * sensor.rate_hz == pytest.approx(points_hz, rel=3e-3)
    assert sensor.times_s.max() < 1 / sensor.rate_hz


@each_case("../lidarsim/staggered", "name row elevation azimuth")
def test_staggered_beams_point_where_drivers_place_them(name, row, elevation, azimuth):
    """Ouster's own formula, and Hesai's: column c at 2π c / columns, azimuths clockwise, begun at
    the rear."""
    sensor, row = named(name), int(row)
    columns = sensor.shape[1]
    turned = 360 / columns * np.arange(columns) + 360 * 10 * sensor.times_s[row, 0]
    around, up = np.radians(180 - turned - float(azimuth)), math.radians(float(elevation))
    x, y = math.cos(up) * np.cos(around), math.cos(up) * np.sin(around)
    expected = np.stack(np.broadcast_arrays(x, y, math.sin(up)), axis=1)
    assert_allclose(sensor.directions_body[row], expected, atol=2e-5)


@each_case("../lidarsim/firing", "name firing begin_us gap_us", json.loads)
def test_beams_fire_in_the_documented_order(name, firing, begin_us, gap_us):
    """While the head turns."""
    sensor = named(name)
    elevation, azimuth = angles_deg(sensor)
    times = sensor.times_s[:, 0]
    order = np.argsort(times)
    assert elevation[order, 0][: len(firing)] == pytest.approx(firing)
    expected = 1e-6 * (begin_us + gap_us * np.arange(len(order)))
    assert_allclose(times[order], expected, rtol=1e-6, atol=1e-12)
    turned = np.unwrap(np.radians(azimuth[order, 5]))
    assert_allclose(np.diff(turned), -2 * math.pi * 10 * gap_us * 1e-6, rtol=1e-6)


@each_case("../lidarsim/patterns", "name points_hz up wide", json.loads)
def test_a_pattern_fills_its_view_without_repeating(name, points_hz, up, wide):
    sensor = named(name)
    elevation, azimuth = angles_deg(sensor)
    assert sensor.shape == (points_hz / 10,)
    assert sensor.times_s[-1] == pytest.approx(0.1, rel=1e-3)
    assert (elevation.min(), elevation.max()) == pytest.approx(tuple(up), abs=0.5)
    assert up[0] - 1e-9 <= elevation.min() <= elevation.max() <= up[1] + 1e-9
    assert wide - 0.5 < np.abs(azimuth).max() <= wide + 1e-9

    def cells(seed, window_s):
        angles = angles_deg(dataclasses.replace(sensor, seed=seed, window_s=window_s))
        return set(map(tuple, np.floor(angles).T.tolist()))

    first, other = cells(1, 0.02), cells(2, 0.02)
    assert len(first & other) < 0.8 * len(first)
    assert first < cells(1, 0.1)


@pytest.mark.parametrize("name", ["realsense-d435", "realsense-d455"])
def test_a_depth_cameras_rays_form_a_square_grid(name):
    """On a plane ahead; half a pixel lies beyond the outermost rays."""
    sensor = named(name)
    assert isinstance(sensor, Pinhole)
    x, y, z = np.moveaxis(sensor.directions_body, -1, 0)
    for lines, fov_deg in ((y / x, 87), ((z / x).T, 58)):
        count = lines.shape[1]
        outermost = math.tan(math.radians(fov_deg / 2)) * (1 - 1 / count)
        expected = np.broadcast_to(np.linspace(outermost, -outermost, count), lines.shape)
        assert_allclose(lines, expected, atol=1e-12)


def test_a_lever_arm_moves_the_origin_of_the_rays_with_the_body():
    """At a yaw of 90° the body's x axis is the world's y axis."""
    sensor = Spinning(elevations_deg=(0.0,), columns=4, lever_arm_m=(0.5, 0.0, 0.2))
    model, pose = model_of('size="1" pos="1 7 3.2"'), Pose.level((1.0, 2.0, 3.0), math.pi / 2)
    on_world = attach(model, "world", sensor, offset=pose, unseen="nothing")
    for scan in (cast(MujocoEngine.of(model), sensor, pose), on_world.scan(data_of(model))):
        assert scan.pose.position == pytest.approx([1.0, 2.5, 3.2])
        assert scan.points() == pytest.approx(np.array([[1.0, 6.0, 3.2]]))


@each_case("../lidarsim/sensors", "family values")
def test_an_impossible_sensor_is_refused(family, values):
    refuses(f"{family} {values}", named(family), **json.loads(values))
