"""A unit of a sensor by its scans: what is measured of a simulated one, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim.noise.chain import Noise
from lidarsim.sensors.catalogue import HELIOS_16P, MID_360, VLP_16
from lidarsim.sensors.device import angles_deg
from scenegen.logs.against import RANGES_M, measure
from scenegen.view.stills import draw_sensor_unit
from scenegen.worlds.clouds import Cloud, read_cloud
from scenegen.worlds.tables import named_lidar
from tests.command_line import ROOT, done
from tests.refusals import refuses, refuses_command
from tests.scenegen import cases

HALF_M = np.array([12.0, 9.0, 3.0])
"""Half the size of the room, in whose middle sensors stand."""
RNG = np.random.default_rng(3)
SHIFTS = RNG.normal(0, 0.1, 16).round(4)
UNIT = replace(
    VLP_16,
    name="mine",
    elevations_deg=tuple(VLP_16.elevations_deg + SHIFTS),
    azimuth_offsets_deg=tuple(RNG.normal(0, 0.02, 16).round(4)),
)
"""A unit of a VLP-16 with angles of its own."""


RAYS = UNIT.directions_sensor.reshape(-1, 3)
RINGS = np.repeat(np.arange(16), VLP_16.shape[1])


def cloud(directions=RAYS, sigma_m=0.0, step_m=0.0, lost=0.0, **fields):
    """A scan of the room, with noise along rays, in steps, and with lost rays."""
    ranges = (HALF_M / np.maximum(np.abs(directions), 1e-9)).min(axis=1)
    ranges += np.random.default_rng(1).normal(0, sigma_m, len(ranges))
    if step_m:
        ranges = np.rint(ranges / step_m) * step_m
    kept = np.random.default_rng(2).random(len(ranges)) >= lost
    return Cloud((ranges[:, None] * directions)[kept], "", **fields)


def test_a_fitted_file_is_the_unit_that_scanned(standing, capsys):
    (standing / "truth.toml").write_bytes(measure([cloud()], VLP_16).encode())
    warehouse = ROOT / "scenes" / "warehouse.xml"
    noise = "range:0.012,dropout:0.03,quantise:0.002"
    scan = f"scan {warehouse} --flight --seed 3 --lidar truth.toml --noise {noise} -o scan.ply"
    done(capsys, f"{scan} --quiet")
    said = done(
        capsys, "sensors velodyne-vlp-16 --against scan.ply --fit mine.toml -o p.png --json"
    )
    facts = json.loads(said)["unit"]
    assert facts["channels"] == 16
    assert facts["range_step_m"] == 0.002
    assert_allclose(facts["elevations_off_deg"][1], np.abs(SHIFTS).max(), atol=1e-4)
    mine = named_lidar("mine.toml")
    assert_allclose(mine.elevations_deg, UNIT.elevations_deg, atol=1e-4)
    beside = np.subtract(mine.azimuth_offsets_deg, UNIT.azimuth_offsets_deg)
    assert np.ptp(beside) < 1e-3
    assert mine.shape == (16, 1808)
    spread, steps, lost = Noise.parse(mine.noise).stages
    assert spread.sigma_m == pytest.approx(0.012, rel=0.05)
    assert steps.step_m == 0.002
    assert lost.share == pytest.approx(0.03, abs=0.006)
    generate = "generate --kind pillar -n 3 --val 0 --test 0 --workers 1 --quiet -o d"
    done(capsys, f"{generate} --lidar mine.toml --noise datasheet")


def test_scans_in_any_order_are_one_unit():
    scan = cloud(sigma_m=0.01)
    mixed = Cloud(RNG.permutation(scan.points), "")
    one, both = measure([scan], VLP_16), measure([mixed, mixed], VLP_16)
    assert_allclose(one.elevations_deg, both.elevations_deg, atol=1e-6)
    assert_allclose(one.steps_deg, both.steps_deg, atol=1e-6)
    assert one.beams.tolist() == both.beams.tolist()


def test_beams_that_begin_beside_the_centre_have_their_own_elevations():
    """By the field ring; 3 cm above the centre are 0.2° at the nearest wall."""
    scan = cloud()
    raised = scan.points + np.array([0.0, 0.0, 0.03])
    unit = measure([Cloud(raised, "", rings=RINGS)], VLP_16)
    assert_allclose(unit.off_deg, SHIFTS[unit.beams], atol=2e-3)
    assert_array_equal(np.sort(unit.beams), np.arange(16))


def test_beams_without_returns_are_left_out():
    elevation = angles_deg(RAYS)[0]
    unit = measure([cloud(RAYS[elevation > -10])], VLP_16)
    assert sorted(VLP_16.elevations_deg[beam] for beam in unit.beams) == [*range(-9, 16, 2)]
    refuses("few", measure, [cloud(RAYS[elevation > -6])], VLP_16)


def test_noise_is_that_of_planes_alone():
    """Half of the room is corrugated, by 0.1 m."""
    scan = cloud(sigma_m=0.02)
    around = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    waves = 1.0 + 0.01 * np.sin(60 * around) * (around > 0)
    planes = measure([scan, Cloud(scan.points * waves[:, None], "")], VLP_16).classes(0, RANGES_M)
    assert planes["noise_m"] == pytest.approx([0.02] * len(planes["from"]), rel=0.1)
    assert sum(planes["planes"]) > 1000


@pytest.mark.parametrize("lost", [0.0, 0.1])
def test_lost_rays_are_counted_on_a_grid(lost):
    unit = measure([cloud(RAYS, 0.01, lost=lost)], VLP_16)
    assert unit.facts()["lost"] == pytest.approx(lost, abs=0.01)


def test_lost_rays_are_unknown_without_a_grid():
    up, around = np.radians(angles_deg(RAYS[RNG.random(len(RAYS)) < 0.5]))
    around += np.radians(RNG.uniform(-0.1, 0.1, len(around)))
    across = np.cos(up)
    uneven = np.stack([across * np.cos(around), across * np.sin(around), np.sin(up)], axis=1)
    assert measure([cloud(uneven)], VLP_16).facts()["lost"] == "unknown"


def test_steps_of_ranges_are_those_of_the_sensor():
    for step_m in (0.002, 0.0):
        unit = measure([cloud(RAYS, 0.01, step_m)], VLP_16)
        assert unit.quantum_m == step_m
    rounded = Cloud(cloud(RAYS, 0.01, 0.002).points.round(3), "")  # by a converter
    assert measure([rounded], VLP_16).quantum_m == 0.0


def test_a_field_ring_is_read(tmp_path):
    points = cloud().points.astype("f4")
    np.save(tmp_path / "scan.npy", np.rec.fromarrays([*points.T, RINGS], names="x,y,z,ring"))
    np.column_stack([points, RINGS, RINGS]).astype("f4").tofile(tmp_path / "scan.pcd.bin")
    for name in ("scan.npy", "scan.pcd.bin"):
        assert_array_equal(read_cloud(tmp_path / name).rings, RINGS)


def test_a_picture_has_beams_ranges_and_noise():
    unit = measure([cloud(sigma_m=0.01)], VLP_16)
    beams, returns, noise = draw_sensor_unit(unit).axes
    assert_allclose(beams.lines[0].get_xydata().T, [unit.elevations_deg, unit.off_deg])
    assert sum(bar.get_height() for bar in returns.patches) == len(unit.ranges_m)
    assert len(noise.lines[0].get_xydata()) == len(unit.planes)


def test_scans_of_another_sensor_are_refused(standing, capsys):
    scan = cloud(step_m=0.002)
    moved = Cloud(scan.points + np.array([0.0, 0.0, 1.0]), "")
    refuses("moved", measure, [moved], VLP_16)
    refuses("nothing", measure, [Cloud(np.zeros((9, 3)), "")], VLP_16)
    refuses("steps", measure, [scan], HELIOS_16P)
    refuses("mm", measure, [Cloud(1e3 * scan.points, "")], VLP_16)
    rings = np.where(RINGS == 3, np.nan, RINGS)
    refuses("rings", measure, [Cloud(scan.points, "", rings=rings)], VLP_16)
    refuses("no channels", measure, [scan], MID_360)
    np.save("scan.npy", cloud().points)
    for (words,) in cases("logs/against_bad_use"):
        refuses_command(capsys, f"sensors {words}")
