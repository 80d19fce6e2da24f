"""Point clouds become maps that agree with the place where rays went, and meshes become the
worlds that they were made of."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import GridSpec, Pose
from lidarsim.engines.voxels import FREE, OCCUPIED, UNKNOWN, VoxelEngine, VoxelMap
from lidarsim.pose import rotate
from scenegen.draw.source import read_world
from scenegen.view.glb import encode_world
from scenegen.worlds.cloud import Survey, map_clouds
from scenegen.worlds.clouds.write import write_points
from scenegen.worlds.world import World
from tests.command_line import refused
from tests.lidarsim.reference import unit
from tests.refusals import check_wording, refuses
from tests.scenegen import each_case
from tests.scenegen.clouds.test_formats import las
from tests.scenegen.worlds.test_place import ORIGIN, VOXEL_M, hall

TRUTH = VoxelMap(hall(), VOXEL_M, np.array(ORIGIN))
VOXELS = Survey(voxel_m=VOXEL_M)


def scanned(count, rays_each):
    """Where the sensor was, and what it saw, so many times."""
    rng, engine, scans = np.random.default_rng(0), VoxelEngine(TRUTH), []
    while len(scans) < count:
        cell = np.array([*rng.integers(10, 60, 2), 8])
        if TRUTH.states[tuple(cell)] == FREE:
            sensor = np.array(ORIGIN) + (cell + 0.4) * VOXEL_M
            rays = unit(rng.normal(size=(rays_each, 3)))
            ranges = engine.cast(sensor[None], rays[None], 100.0)[0]
            seen = np.isfinite(ranges)
            scans.append((sensor, sensor + rays[seen] * ranges[seen, None]))
    return scans


@pytest.fixture(scope="module")
def scans():
    return scanned(4, 3000)


def write_ply(path, points, **columns):
    """Points as float64, and further columns."""
    table = dict(zip("xyz", points.T, strict=True)) | columns
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property double {name}\n" for name in table) + "end_header\n"
    path.write_bytes(head.encode() + np.column_stack([*table.values()]).astype("<f8").tobytes())
    return path


def surveyed(folder, scans, how):
    """The map of scans that say in one of these ways where they were made."""
    if how in (".las", ".ply"):
        points = np.concatenate([points for _, points in scans])
        origins = np.concatenate([np.broadcast_to(at, points.shape) for at, points in scans])
        columns = dict(zip(("vp_x", "vp_y", "vp_z"), origins.T, strict=True))
        write = write_ply if how == ".ply" else partial(las, scales=[1e-5] * 3)
        return map_clouds([write(folder / f"a{how}", points, **columns)], VOXELS)
    turn, files, rows = Pose.level((0, 0, 0), 0.7).quaternion, [], []
    for n, (sensor, points) in enumerate(scans):
        files.append(folder / f"{n}.{'pcd' if how == 'viewpoint' else 'npy'}")
        if how == "viewpoint":
            write_points(files[-1], points, None, {"frame": "world", "sensor_position": sensor})
        elif how == "places":
            np.save(files[-1], points)
            rows.append(sensor)
        else:
            np.save(files[-1], rotate(turn * (1, -1, -1, -1), points - sensor))
            rows.append([n, *sensor, *np.roll(turn, -1)])
    np.savetxt(folder / "poses.txt", rows)
    return map_clouds(files, VOXELS, poses=folder / "poses.txt" if rows else None)


def test_matrices_of_kittis_camera_are_refused(tmp_path, monkeypatch):
    """As ingest asks what they are of, so does map: see its --poses-of."""
    (tmp_path / "velodyne").mkdir()
    cloud, poses = tmp_path / "velodyne" / "0.xyz", tmp_path / "poses.txt"
    cloud.write_text("1 0 0\n0 2 0\n")
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    refuses("of its camera", map_clouds, [cloud], VOXELS, poses=poses)
    (tmp_path / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    monkeypatch.chdir(cloud.parent)
    assert map_clouds([Path("0.xyz")], VOXELS, poses=poses).points == 2


def within(part, whole):
    """The slices of a map that hold a part of it."""
    corner = np.rint((part.origin - whole.origin) / VOXEL_M).astype(int)
    assert_allclose(part.origin, whole.origin + corner * VOXEL_M, atol=1e-9)
    return tuple(map(slice, corner, corner + part.states.shape))


@pytest.mark.parametrize("how", [".ply", "viewpoint", "places", "tum", ".las"])
def test_a_clouds_map_is_the_place_where_rays_went(scans, tmp_path, how, rng):
    voxels = surveyed(tmp_path, scans, how).voxels
    truth = TRUTH.states[within(voxels, TRUTH)]
    assert (truth[voxels.states == OCCUPIED] == OCCUPIED).all()
    # a ray may pass through less than 0.1 mm of what it does not see
    assert (truth[voxels.states == FREE] == OCCUPIED).mean() < 1e-3
    low = voxels.origin + rng.choice(np.argwhere(voxels.states == FREE), 60) * VOXEL_M
    corners = low + np.array([0.0, VOXEL_M])[:, None, None, None]
    share, is_met = np.linspace(0.0, 1.0, 150)[:, None, None], []
    for sensor, points in scans:
        cells = np.floor((sensor + share * (points - sensor) - voxels.origin) / VOXEL_M).astype(int)
        states = voxels.states[tuple(np.moveaxis(cells, -1, 0))]
        assert (states != UNKNOWN).all()
        assert (states[-1] == OCCUPIED).all()
        # a segment from the sensor to one of its points meets a voxel that is free
        sides = (corners - sensor) / (points - sensor)[:, None]
        begin, end = sides.min(axis=0).max(axis=2), sides.max(axis=0).min(axis=2)
        is_met.append((np.minimum(end, 1.0) > np.maximum(begin, 0.0)).any(axis=0))
    assert np.any(is_met, axis=0).all()


def test_units_axes_and_offsets_change_no_voxel(scans, tmp_path):
    sensor, points = scans[0]

    def mapped(change=np.array, survey=VOXELS, **options):
        file = write_ply(tmp_path / "a.ply", change(points))
        return map_clouds([file], survey, sensor=change(sensor), **options)

    plain, away = mapped(), np.array([652_000.0, 5_403_000.0, 0.0])
    inches = Survey(voxel_m=VOXEL_M, unit_m=0.0254, up="y")
    turned = mapped(lambda values: values[..., [0, 2, 1]] * (1, 1, -1) / 0.0254, inches)
    far = mapped(lambda values: values + away)
    assert not plain.offset.any()
    for other, offset in ((turned, 0 * away), (far, away)):
        assert_array_equal(other.voxels.states, plain.voxels.states)
        assert_allclose(other.voxels.origin + other.offset - plain.voxels.origin, offset)
    boxed = mapped(box=(*(points.min(axis=0) + 2), *(points.max(axis=0) - 2)))
    assert 0 < boxed.points < plain.points == len(points)
    part = within(boxed.voxels, plain.voxels)
    assert_array_equal(boxed.voxels.states, plain.voxels.states[part])


@pytest.mark.parametrize("how", [".ply", "tum"])
def test_rays_without_a_return_mark_nothing(scans, tmp_path, how):
    """A third of the points are 0 0 0 in the sensor's frame."""
    sensor, points = scans[0]
    lost = np.arange(len(points)) % 3 == 0
    marked = surveyed(tmp_path, [(sensor, np.where(lost[:, None], sensor, points))], how)
    left_out = surveyed(tmp_path, [(sensor, points[~lost])], how)
    assert_array_equal(marked.voxels.states, left_out.voxels.states)
    assert marked.points == left_out.points == (~lost).sum()
    assert marked.read.endswith(f"; {lost.sum():,} without a return dropped")


def test_what_is_assumed_free_lies_above_the_lowest_point(scans, tmp_path):
    """The origin is a place as any in a registered cloud, and no return beside a sensor."""
    np.savetxt(cloud := tmp_path / "a.xyz", [[0, 0, 0], [np.nan, 0, 0], *scans[0][1]])
    registered = map_clouds([cloud], Survey(assume_free=True))
    assert registered.points == len(scans[0][1]) + 1
    assert map_clouds([cloud], sensor=(0.0, 0.0, 0.05)).points == len(scans[0][1])
    states = registered.voxels.states
    full = states == OCCUPIED
    above = np.logical_or.accumulate(full, axis=2) & ~full
    assert_array_equal(states == FREE, above)
    assert (states == UNKNOWN).any()


@each_case("worlds/cloud_no_maps", "name lines options")
def test_what_is_no_map_is_refused(standing, capsys, name, lines, options):
    Path("two.txt").write_text("0 0 0\n0 0 1\n")
    Path("flat.txt").write_text("0 " * 12)
    Path("words.txt").write_text("words")
    Path(name).write_text(lines.replace("; ", "\n"))
    line = refused(capsys, "map", name, *options.split())
    check_wording(f"{lines} {options}", line.rstrip("\n"))
    assert not Path("map.npz").exists()


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".stl"])
def test_a_mesh_is_the_world_that_it_was_made_of(tmp_path, suffix):
    document, file = tmp_path / "a.xml", tmp_path / f"a{suffix}"
    document.write_text(
        "<mujoco><worldbody><geom type='box' size='1 2 3' pos='4 0 3' euler='0 0 30'/>"
        "<geom type='box' size='5 5 .2' pos='0 0 -.3'/></worldbody></mujoco>"
    )
    drawn = read_world(document)
    assert isinstance(drawn, World)
    (tmp_path / "a.glb").write_bytes(encode_world(drawn))
    if suffix != ".glb":
        parts = trimesh.load(tmp_path / "a.glb", force="scene")
        parts.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
        parts.to_mesh().export(file)
    place = GridSpec(shape=(60, 60, 40)), np.array([-6.03, -6.03, -1.03])
    truths = [world.truth(*place)["occupancy"] for world in (read_world(file), drawn)]
    assert_array_equal(*truths)


@each_case("worlds/cloud_no_meshes", "name content")
def test_what_is_no_mesh_is_refused(tmp_path, name, content):
    (tmp_path / name).write_text(content.replace("; ", "\n"))
    refuses(f"{name} {content}", read_world, tmp_path / name)
