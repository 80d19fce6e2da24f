"""Point clouds become maps that agree with the place where rays went, and meshes become the
worlds that they were made of."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from lidarsim import GridSpec, Pose
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelEngine, VoxelMap
from lidarsim.pose import rotate
from scenegen.base.errors import DatasetError, SceneError
from scenegen.draw.source import read_world
from scenegen.view.glb import encode_world
from scenegen.worlds.cloud import Survey, map_clouds
from scenegen.worlds.clouds.write import write_points
from scenegen.worlds.world import World
from tests.command_line import refused
from tests.scenegen import cases, refuses
from tests.scenegen.worlds.test_place import ORIGIN, VOXEL_M, hall

TRUTH = VoxelMap(hall(), VOXEL_M, np.array(ORIGIN))
VOXELS = Survey(voxel_m=VOXEL_M)
Scans = list[tuple[NDArray[np.float64], NDArray[np.float64]]]


def scanned(count, rays_each):
    """Where the sensor was, and what it saw, so many times."""
    rng, found = np.random.default_rng(0), Scans()
    while len(found) < count:
        cell = rng.integers(10, 60, 2)
        if TRUTH.states[cell[0], cell[1], 8] != FREE:
            continue
        sensor = np.array(ORIGIN) + (np.array([*cell, 8]) + 0.4) * VOXEL_M
        rays = rng.normal(size=(rays_each, 3))
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        ranges = VoxelEngine(TRUTH).cast(sensor[None], rays[None], 100.0)[0]
        seen = np.isfinite(ranges)
        found.append((sensor, sensor + rays[seen] * ranges[seen, None]))
    return found


@pytest.fixture(scope="module")
def scans():
    return scanned(4, 3000)


def joined(scans):
    """All points, and where each was seen from."""
    sensors = [np.broadcast_to(at, points.shape) for at, points in scans]
    return np.concatenate([points for _, points in scans]), np.concatenate(sensors)


def write_ply(path, points, sensors=None):
    """Points as float64, and in fields of their own where they were seen from."""
    names = ["x", "y", "z"] if sensors is None else ["x", "y", "z", "vp_x", "vp_y", "vp_z"]
    rows = points if sensors is None else np.concatenate([points, sensors], axis=1)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
    head += "".join(f"property double {name}\n" for name in names) + "end_header\n"
    path.write_bytes(head.encode() + rows.astype("<f8").tobytes())
    return path


def write_las(path, points, sensors=None):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [1e-5] * 3, np.floor(points[0])
    if sensors is not None:
        names = [f"vp_{axis}" for axis in "xyz"]
        header.add_extra_dims([laspy.ExtraBytesParams(name, "f8") for name in names])
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    for name, column in zip("xyz", () if sensors is None else sensors.T, strict=False):
        las[f"vp_{name}"] = column
    las.write(path)
    return path


def surveyed(folder, scans, how):
    """The map of scans that say in one of these ways where they were made."""
    every, sensors = joined(scans)
    if how in (".las", ".laz"):
        return map_clouds([write_las(folder / f"a{how}", every, sensors)], VOXELS).voxels
    if how == "fields":
        return map_clouds([write_ply(folder / "a.ply", every, sensors)], VOXELS).voxels
    files = [folder / f"{n}.{'pcd' if how == 'viewpoint' else 'npy'}" for n in range(len(scans))]
    if how == "viewpoint":
        for file, (sensor, points) in zip(files, scans, strict=True):
            write_points(file, points, None, {"frame": "world", "sensor_position": sensor})
        return map_clouds(files, VOXELS).voxels
    turn, rows = Pose.level((0, 0, 0), 0.7).quaternion, []
    for time, (file, (sensor, points)) in enumerate(zip(files, scans, strict=True)):
        own = points if how == "places" else rotate(turn * (1, -1, -1, -1), points - sensor)
        np.save(file, own)
        axes = np.column_stack([rotate(turn, np.eye(3)).T, sensor])
        poses = {"places": sensor, "tum": [time, *sensor, *np.roll(turn, -1)], "kitti": axes}
        rows.append(np.ravel(poses[how]))
    np.savetxt(folder / "poses.txt", rows)
    return map_clouds(files, VOXELS, poses=folder / "poses.txt").voxels


def test_matrices_of_kitti_s_camera_are_not_taken_for_the_sensor_s(tmp_path, monkeypatch):
    """As ingest asks what they are of, so does map: see its --poses-of."""
    (tmp_path / "velodyne").mkdir()
    cloud, poses = tmp_path / "velodyne" / "0.xyz", tmp_path / "poses.txt"
    cloud.write_text("1 0 0\n0 2 0\n")
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    for tr in ("0 -1 0 0 0 0 -1 0 1 0 0 0", "1 0 0 0 0 1 0 0 0 0 1 0"):
        (tmp_path / "calib.txt").write_text(f"Tr: {tr}\n")
        if tr.startswith("0"):
            refuses("may be those of its camera", map_clouds, [cloud], VOXELS, poses=poses)
    monkeypatch.chdir(cloud.parent)
    assert map_clouds([Path("0.xyz")], VOXELS, poses=poses).points == 2


def within(part, whole):
    """The slices of a map that hold a part of it."""
    corner = np.rint((part.origin - whole.origin) / VOXEL_M).astype(int)
    assert_allclose(part.origin, whole.origin + corner * VOXEL_M, atol=1e-9)
    return tuple(map(slice, corner, corner + part.states.shape))


@pytest.mark.parametrize("how", ["fields", "viewpoint", "places", "tum", "kitti", ".las", ".laz"])
def test_a_cloud_s_map_is_the_place_where_rays_went(scans, tmp_path, how):
    voxels = surveyed(tmp_path, scans, how)
    truth = TRUTH.states[within(voxels, TRUTH)]
    assert (truth[voxels.states == OCCUPIED] == OCCUPIED).all()
    # a ray may pass through less than 0.1 mm of what it does not see
    assert (truth[voxels.states == FREE] == OCCUPIED).mean() < 1e-3
    share = np.linspace(0.0, 1.0, 150)[:, None, None]
    for sensor, points in scans:
        way = sensor + share * (points - sensor)
        cells = np.floor((way - voxels.origin) / VOXEL_M).astype(int)
        found = voxels.states[tuple(np.moveaxis(cells, -1, 0))]
        assert (found != UNKNOWN).all()
        assert (found[-1] == OCCUPIED).all()
    cells = np.argwhere(voxels.states == FREE)
    chosen = np.random.default_rng(0).choice(cells, 60)
    for low in voxels.origin + chosen * VOXEL_M:
        assert any(meets(*scan, low) for scan in scans)


def meets(sensor, points, low):
    """Whether a segment from the sensor to one of the points meets the voxel at `low`."""
    sides = np.stack([low - sensor, low + VOXEL_M - sensor])[:, None] / (points - sensor)
    begin, end = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
    return bool((np.minimum(end, 1.0) > np.maximum(begin, 0.0)).any())


def test_units_axes_and_offsets_change_no_voxel(scans, tmp_path):
    sensor, points = scans[0]

    def mapped(points, sensor, survey=VOXELS, **more):
        return map_clouds([write_ply(tmp_path / "a.ply", points)], survey, sensor=sensor, **more)

    plain, inches = mapped(points, sensor), Survey(voxel_m=VOXEL_M, unit_m=0.0254, up="y")
    turned = mapped(
        *(its[..., [0, 2, 1]] * (1, 1, -1) / 0.0254 for its in (points, sensor)), inches
    )
    away = np.array([652_000.0, 5_403_000.0, 0.0])
    far = mapped(points + away, sensor + away)
    boxed = mapped(points, sensor, box=(*(points.min(axis=0) + 2), *(points.max(axis=0) - 2)))
    assert plain.offset.tolist() == [0, 0, 0]
    for other in (turned, far):
        assert_array_equal(other.voxels.states, plain.voxels.states)
        assert_allclose(
            other.voxels.origin + other.offset - plain.voxels.origin, away * other.offset.any()
        )
    assert 0 < boxed.points < plain.points == len(points)
    part = within(boxed.voxels, plain.voxels)
    assert_array_equal(boxed.voxels.states, plain.voxels.states[part])


@pytest.mark.parametrize("how", ["fields", "sensor", "tum"])
def test_rays_without_a_return_mark_nothing(scans, tmp_path, how):
    """A third of the points are 0 0 0 in the sensor's frame."""
    sensor, points = scans[0]
    lost = np.arange(len(points)) % 3 == 0
    maps = []
    for returns in (np.where(lost[:, None], sensor, points), points[~lost]):
        more, file = {}, tmp_path / "a.npy"
        if how == "fields":
            file = write_ply(tmp_path / "a.ply", returns, np.broadcast_to(sensor, returns.shape))
        elif how == "sensor":
            np.save(file, returns)
            more = {"sensor": sensor}
        else:
            np.save(file, returns - sensor)
            (tmp_path / "poses.txt").write_text(f"0 {' '.join(map(repr, sensor.tolist()))} 0 0 0 1")
            more = {"poses": tmp_path / "poses.txt"}
        maps.append(map_clouds([file], VOXELS, **more))
    assert_array_equal(maps[0].voxels.states, maps[1].voxels.states)
    assert maps[0].points == maps[1].points == (~lost).sum()
    assert maps[0].read.startswith(f"read: {len(points):,} points, x y z")
    assert maps[0].read.endswith(f"; {lost.sum():,} without a return dropped")


def test_a_registered_cloud_keeps_its_origin(tmp_path):
    np.savetxt(tmp_path / "a.xyz", [[0, 0, 0], [1, 0, 0], [np.nan, 0, 0]])
    made = map_clouds([tmp_path / "a.xyz"], Survey(assume_free=True))
    assert made.points == 2
    assert made.read == "read: 3 points, x y z (.xyz, text); 1 without a return dropped"
    assert map_clouds([tmp_path / "a.xyz"], sensor=(0.0, 0.0, 0.05)).points == 1


def test_what_is_assumed_free_lies_above_the_lowest_point(scans, tmp_path):
    np.savetxt(tmp_path / "a.xyz", scans[0][1])
    states = map_clouds([tmp_path / "a.xyz"], Survey(assume_free=True)).voxels.states
    full = states == OCCUPIED
    above = np.logical_or.accumulate(full, axis=2) & ~full
    assert_array_equal(states == FREE, above)
    assert (states == UNKNOWN).any()


@pytest.mark.parametrize(("name", "lines", "options", "said"), cases("worlds/cloud_no_maps"))
def test_what_is_no_map_ends_in_a_line(standing, capsys, name, lines, options, said):
    Path("two.txt").write_text("0 0 0\n0 0 1\n")
    Path("flat.txt").write_text("0 " * 12)
    Path("words.txt").write_text("words")
    Path(name).write_text(lines.replace("; ", "\n"))
    assert said in refused(capsys, "map", name, *options.split())
    assert not Path("map.npz").exists()


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".stl"])
def test_a_mesh_is_the_world_that_it_was_made_of(tmp_path, suffix):
    document = tmp_path / "a.xml"
    document.write_text(
        "<mujoco><worldbody><geom type='box' size='1 2 3' pos='4 0 3' euler='0 0 30'/>"
        "<geom type='box' size='5 5 .2' pos='0 0 -.3'/></worldbody></mujoco>"
    )
    drawn = read_world(document)
    assert isinstance(drawn, World)
    (tmp_path / "a.glb").write_bytes(encode_world(drawn))
    if suffix != ".glb":
        parts = trimesh.load(tmp_path / "a.glb", force="scene")
        parts.apply_transform([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
        parts.to_mesh().export(tmp_path / f"a{suffix}")
    found = read_world(tmp_path / f"a{suffix}")
    grid, origin = GridSpec(shape=(60, 60, 40)), np.array([-6.03, -6.03, -1.03])
    assert_array_equal(
        found.truth(grid, origin)["occupancy"], drawn.truth(grid, origin)["occupancy"]
    )


@pytest.mark.parametrize(("name", "content", "said"), cases("worlds/cloud_no_meshes"))
def test_what_is_no_mesh_ends_in_a_line(tmp_path, name, content, said):
    (tmp_path / name).write_text(content.replace("; ", "\n"))
    with pytest.raises((SceneError, DatasetError), match=said):
        read_world(tmp_path / name)
