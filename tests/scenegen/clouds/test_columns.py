"""Columns without names: how many a point has is seen by the numbers, or asked for."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scenegen.worlds.clouds import read_cloud
from tests.refusals import refuses

RNG = np.random.default_rng(0)


def room(count):
    """What a sensor 1.5 m above the floor sees of a room, (N, 3), float32, in no order."""
    around, up = RNG.uniform(-np.pi, np.pi, count), RNG.uniform(-0.4, 0.2, count)
    rays = np.stack([np.cos(around), np.sin(around), np.tan(up)], axis=1)
    walls = np.array([6, 5, 1.5]) / np.maximum(np.abs(rays), 1e-9)
    walls[up > 0, 2] = np.inf  # no ceiling
    return (rays * walls.min(axis=1, keepdims=True)).astype("<f4")


# of 9600 points, every number of columns from 3 to 6, and 8, divides the file
ROOM = room(9600)
BYTES, SHARES = RNG.integers(0, 256, 9600), RNG.uniform(0, 1, 9600)
RINGS, TIMES = np.arange(9600) % 32, np.linspace(0, 0.1, 9600)
NORMALS = RNG.normal(size=(3, 9600)) * 0.6
NO_RETURN = np.where(RNG.random((9600, 1)) < 0.33, np.nan, ROOM)
FURTHER = {
    "alone": (),
    "intensity": (SHARES,),
    "reflectivity": (BYTES,),
    "no-intensity": (np.zeros(9600),),
    "ring": (BYTES, RINGS),
    "time": (BYTES, RINGS, TIMES),
    "normals": tuple(NORMALS),
    "colours": tuple(RNG.integers(0, 256, (3, 9600))),
}


@pytest.mark.parametrize("name", FURTHER)
@pytest.mark.parametrize("points", [ROOM, np.abs(ROOM), NO_RETURN, ROOM * (RNG.random() > 0.3)])
def test_columns_are_seen_by_the_numbers(tmp_path, points, name):
    np.column_stack([points, *FURTHER[name]]).astype("<f4").tofile(tmp_path / "scan.bin")
    cloud = read_cloud(tmp_path / "scan.bin")
    assert_array_equal(cloud.points, points)
    assert f"{3 + len(FURTHER[name])} columns" in cloud.layout


@pytest.mark.parametrize("count", [9600, 32, 1])
def test_nuscenes_has_five_columns(tmp_path, count):
    rows = np.column_stack([ROOM, BYTES, RINGS])[:count].astype("<f4")
    rows.tofile(tmp_path / "n015__LIDAR_TOP__1.PCD.bin")
    cloud = read_cloud(tmp_path / "n015__LIDAR_TOP__1.PCD.bin")
    assert_array_equal(cloud.points, rows[:, :3])
    assert cloud.layout == "x y z intensity ring (nuScenes .pcd.bin, 5 columns)"


def test_kittis_folder_says_what_few_points_do_not(tmp_path):
    rows, path = np.full((60, 4), 7.0, "<f4"), tmp_path / "velodyne" / "000000.bin"
    path.parent.mkdir()
    for file in (path, tmp_path / "scan.bin"):
        rows.tofile(file)
    assert_array_equal(read_cloud(path).points, rows[:, :3])
    refuses("elsewhere", read_cloud, tmp_path / "scan.bin")
    assert_array_equal(read_cloud(tmp_path / "scan.bin", columns=6).points, np.full((40, 3), 7.0))


UNTOLD = {
    "all three are alike": RNG.normal(size=(9600, 3)),
    "shares": RNG.uniform(0, 1, (9600, 4)),
    "doubles": ROOM.astype("<f8").view("<f4"),
    "huge": np.full((60, 4), 3e38),
    "whole numbers": np.arange(9600, dtype="<i4").view("<f4"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", UNTOLD)
def test_what_numbers_do_not_tell_is_asked_for(tmp_path, name):
    UNTOLD[name].astype("<f4").tofile(tmp_path / "scan.bin")
    refuses(name, read_cloud, tmp_path / "scan.bin")


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
@pytest.mark.parametrize("columns", [3, 4])
def test_arrays_lie_either_way(tmp_path, suffix, columns):
    rows, path = np.column_stack([ROOM, SHARES])[:, :columns], tmp_path / f"scan{suffix}"
    for array in (rows, rows.T, rows[:1], rows[:9].T):
        np.save(path, array) if suffix == ".npy" else np.savez(path, points=array)
        assert_array_equal(read_cloud(path).points, rows[: array.size // columns, :3])


def test_fields_of_arrays_count_by_name(tmp_path):
    """Times that are no column of numbers are left out."""
    fields = [
        ("time", "S3"),
        *((axis, "f4") for axis in "zyx"),
        ("stamps", "f4", (2,)),
        ("t", "u4"),
    ]
    rows = np.zeros(9600, fields)
    for axis, column in zip("xyz", ROOM.T, strict=True):
        rows[axis] = column
    np.save(tmp_path / "a.npy", rows)
    cloud = read_cloud(tmp_path / "a.npy")
    assert_array_equal(cloud.points, ROOM)
    assert list(cloud.times) == ["t"]


def test_arrays_of_few_points_are_asked_about(tmp_path):
    path, square = tmp_path / "scan.npy", RNG.normal(size=(4, 4))
    np.save(path, square)
    refuses("square", read_cloud, path)
    assert_array_equal(read_cloud(path, columns=4).points, square[:, :3])
    np.save(path, square[:3])
    assert_array_equal(read_cloud(path, columns=3).points, square[:3].T)
    assert_array_equal(read_cloud(path, columns=4).points, square[:3, :3])
    refuses("columns=5", read_cloud, path, columns=5)
    np.save(path, RNG.normal(size=(100, 90)))
    refuses("90 columns", read_cloud, path)


def test_columns_are_for_files_without_names(tmp_path):
    np.savetxt(tmp_path / "scan.xyz", ROOM[:5])
    refuses("text", read_cloud, tmp_path / "scan.xyz", columns=4)


@pytest.mark.parametrize("arrays", [{"states": [0.0], "voxel_m": 0.2}, {"xyz": ROOM}])
def test_archives_say_what_they_hold_instead(tmp_path, arrays):
    np.savez(tmp_path / "a.npz", **arrays)
    refuses([*arrays], read_cloud, tmp_path / "a.npz")
