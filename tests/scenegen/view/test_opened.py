"""Scans, logs, maps and worlds are shown as samples are: in a box that holds
them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import Pose
from lidarsim.engines.voxels import FREE, OCCUPIED, VoxelMap
from scenegen.base.paths import TYPES, what_is
from scenegen.dataset.archive import write_extracted
from scenegen.dataset.read import Dataset
from scenegen.draw.source import read_world
from scenegen.logs import LogScan
from scenegen.logs.record import write_log
from scenegen.view import opened
from scenegen.view.notebook import page_of, show
from scenegen.worlds.movers import encoded
from scenegen.worlds.place import encode_map
from tests.command_line import ROOT, done, refused
from tests.scenegen import refuses
from tests.scenegen.test_moving_samples import moving as moving  # a fixture
from tests.scenegen.view.test_page import Seen, array

POINTS = np.array([[3.0, 0.0, 0.5], [0.0, -2.0, 1.5], [1.0, 1.0, -1.0]])


@pytest.fixture
def saved(tmp_path):
    """Writes points to a file; its path."""

    def save(points):
        np.save(tmp_path / "cloud.npy", points)
        return tmp_path / "cloud.npy"

    return save


@pytest.fixture
def mapped(tmp_path):
    """Writes a map of voxels of 0.5 m that have these states, and shows it."""

    def show_map(states, corner=(0.0, 0.0, 0.0)):
        path = tmp_path / "map.npz"
        path.write_bytes(encode_map(VoxelMap(states, 0.5, np.array(corner)), "map"))
        (look,) = opened.looks_of_world(path)
        return look

    return show_map


@pytest.fixture
def log(tmp_path):
    """Three scans of a sensor that moves along x and turns left."""
    poses = [Pose.level((float(n), 0.0, 1.0), n * np.pi / 2) for n in range(3)]
    scans = [LogScan(float(n), pose, POINTS) for n, pose in enumerate(poses)]
    write_log(tmp_path / "log", scans)
    return tmp_path / "log"


def test_a_scan_lies_in_its_box(saved):
    (look,) = opened.looks_of_scan(saved(POINTS))
    low, high = look.corners
    assert_array_equal(look.points, POINTS)
    assert ((low <= POINTS) & (high >= POINTS)).all()
    cells = look.grid.index(POINTS, look.origin)
    assert_array_equal(np.argwhere(look.masks["observed"]), np.unique(cells, axis=0))


def test_points_in_map_coordinates_have_a_box_without_a_sensor(saved):
    (look,) = opened.looks_of_scan(saved(POINTS + np.array([5e5, 5.4e6, 120.0])))
    assert (look.grid.voxel_m, look.has_sensor, look.figures()["returns"]) == (0.05, False, "3")


def test_a_dense_scan_is_thinned_and_says_so(saved, monkeypatch):
    monkeypatch.setattr(opened, "MAX_POINTS", 10)
    (look,) = opened.looks_of_scan(saved(np.random.default_rng(0).uniform(-5, 5, (95, 3))))
    assert len(look.points) == 10
    assert look.missing == ("cloud.npy: one point in 10 is drawn, 10 of 95",)


def test_scans_of_a_log_lie_in_the_world(log):
    first, second, third = opened.looks_of_log(log)
    assert_allclose(first.points, POINTS + np.array([0, 0, 1]), atol=1e-5)
    assert_allclose(second.points[0], (1.0, 3.0, 1.5), atol=1e-5)
    assert_allclose(third.position, (2.0, 0.0, 1.0))
    assert first.grid == third.grid


def test_a_long_log_is_shown_in_part(log, monkeypatch):
    monkeypatch.setattr(opened, "MAX_FRAMES", 2)
    first, last = opened.looks_of_log(log)
    assert [first.position[0], last.position[0]] == [0.0, 2.0]
    assert first.missing == ("2 of 3 scans are shown, evenly spread",)


def test_a_map_shows_what_is_unknown(mapped):
    states = np.zeros((6, 5, 4), np.uint8)
    states[1:5, 1:4, 1:3] = FREE
    states[2, 2, 1] = OCCUPIED
    look = mapped(states, (1.0, 2.0, 3.0))
    centre = look.origin + (np.argwhere(look.masks["occupancy"]) + 0.5) * look.grid.voxel_m
    assert ((centre >= (2.0, 3.0, 3.5)) & (centre <= (2.5, 3.5, 4.0))).all()
    assert look.masks["unknown"].mean() == pytest.approx((states == 0).mean(), abs=0.1)
    assert not look.has_sensor


def test_a_map_without_free_space_is_shown(mapped):
    assert mapped(np.full((4, 3, 2), OCCUPIED, np.uint8)).masks["occupancy"].sum() >= 24


def test_columns_and_poses_are_taken(log, tmp_path):
    poses, clouds = tmp_path / "poses.txt", tmp_path / "clouds"
    (log / "poses.txt").rename(poses)
    looks = opened.looks_of_scans(log, poses=poses)
    assert_allclose(looks[2].position, (2.0, 0.0, 1.0))
    clouds.mkdir()
    np.hstack([POINTS, POINTS]).astype("<f4").tofile(clouds / "a.bin")
    (look,) = opened.looks_of_scans(clouds, columns=6)
    assert_allclose(look.points, POINTS)


def test_a_world_is_shown_with_its_surfaces():
    path = ROOT / "scenes" / "room_with_gap.xml"
    (look,) = opened.looks_of_world(path)
    truth = read_world(path).truth(look.grid, look.origin)["occupancy"]
    assert_array_equal(look.masks["occupancy"], truth)
    assert look.missing == (
        "voxels are drawn where the sensor may fly and below, x -11 to 11 m, y -7 to 7 m, "
        "z -0.2 to 5 m; 103 of 240 solids reach beyond",
    )
    (sample,) = Seen(page_of(str(path)).html).data()["samples"]
    corners = array(sample["triangles"], "<f4")
    assert len(corners) == sum(mesh.triangles.size for mesh in look.surfaces)
    assert sample["sensor"] is False


def test_a_world_of_ours_shows_its_movers(moving, tmp_path):
    path, dataset = tmp_path / "world.xml", Dataset(moving)
    write_extracted(dataset.world("train", 0), path)
    (look,) = opened.looks_of_world(path)
    movers = dataset.compile("train", 0).movers
    assert encoded(look.timeline.movers) == encoded(movers)
    assert look.timeline.end_s == movers.period_s == 32.0


@pytest.mark.parametrize("low", [(0.0, 0.0, 0.0), (-7.3, 1e3, 0.01)])
@pytest.mark.parametrize("extent", [(1.0, 1.0, 1.0), (1e4, 3.0, 2.0), (900.0, 900.0, 40.0)])
def test_a_box_is_held_by_few_voxels(low, extent):
    grid, origin = opened.box_around(np.array(low), np.array(low) + extent)
    assert_array_equal(origin, low)
    assert (grid.extent_m >= extent).all()
    assert np.prod(grid.shape) <= opened.MAX_CELLS


def test_a_box_that_no_page_holds_is_refused():
    refuses("cut it", opened.box_around, np.zeros(3), np.full(3, 1e6))


def test_a_cloud_without_returns_is_refused(saved):
    refuses("none of its points", opened.looks_of_scan, saved(np.full((4, 3), np.nan)))


def test_view_writes_a_page_of_a_log(capsys, log, tmp_path):
    done(capsys, f"view {log} --html {tmp_path}/log.html")
    data = Seen((tmp_path / "log.html").read_text()).data()
    assert [sample["name"] for sample in data["samples"]] == ["0.00 s", "1.00 s", "2.00 s"]
    assert data["film"] is TYPES[what_is(log)].film is True


def test_a_page_replaces_no_other_file(capsys, saved):
    cloud = saved(POINTS)
    before = cloud.read_bytes()
    assert ".html" in refused(capsys, f"view {cloud} -o {cloud}")
    refuses("html", show, str(cloud), out=cloud)
    assert cloud.read_bytes() == before


def test_view_refuses_options_of_datasets_and_what_it_cannot_show(capsys, saved, made, tmp_path):
    (tmp_path / "recipe.toml").write_text("kind = 'pillar'\n")
    (ingested := tmp_path / "ingested").mkdir()
    np.savez(ingested / "place-000.npz", states=0)
    for words, line in {
        f"{ingested}": "place-000.npz; give that",
        f"{saved(POINTS)} --split test": "--split: is not for the type scan",
        f"{made} --columns 4": "--columns: is not for the type dataset",
        f"{tmp_path}/recipe.toml": "recipe",
    }.items():
        assert line in refused(capsys, f"view {words}")
