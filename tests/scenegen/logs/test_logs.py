"""Logs: flights that are recorded, files that are read back, and maps that agree with the world."""

import dataclasses
import itertools
import json
import math
import os
import signal

import numpy as np
import pytest

import scenegen.logs.fuse
from lidarsim import AnalyticEngine, GridSpec, Lidar, Pose, cast
from lidarsim.noise.chain import Noise
from lidarsim.sensors.catalogue import MID_360
from lidarsim.voxelization import unknown_grid
from scenegen.draw.source import read_world
from scenegen.logs import Cruise, Fusing, LogScan
from scenegen.logs.bags import LIVOX
from scenegen.logs.fuse import _count, _settle, ingest
from scenegen.logs.log import Log
from scenegen.logs.read import read_log
from scenegen.logs.record import cruise_poses, matrix_of, record, write_log
from scenegen.worlds.clouds.write import write_points
from scenegen.worlds.place import read_place
from tests.command_line import done
from tests.conftest import contents
from tests.refusals import refuses, refuses_command
from tests.scenegen import each_case
from tests.scenegen.conftest import names
from tests.scenegen.logs.bags import Bag, named
from tests.scenegen.logs.conftest import RECORD, SENSOR


def test_a_long_flight_keeps_its_bounds(here):
    world, cruise = read_world(here / "room.xml"), Cruise(length_m=60, speed_mps=3)
    poses = cruise_poses(world, cruise, 0.1, seed=1)
    positions = np.array([pose.position for pose in poses])
    speeds, pulls = (np.linalg.norm(np.diff(positions, n, axis=0), axis=1) / 0.1**n for n in (1, 2))
    yaws = np.unwrap([2 * math.atan2(pose.quaternion[3], pose.quaternion[0]) for pose in poses])
    assert 2.9 < speeds.max() <= 3 + 1e-6
    assert 0.1 * speeds.sum() == pytest.approx(60, abs=3)
    assert abs(np.degrees(np.diff(yaws))).max() <= 0.1 * 60 + 1e-6
    assert pulls.max() <= 2 * cruise.acceleration_mps2
    assert min(world.clearance.at(*point) for point in positions) >= 0.1


def test_a_log_that_is_recorded_and_ingested_agrees_with_its_world(here, capsys):
    done(capsys, f"{RECORD} -o still --quiet")
    counts = json.loads(done(capsys, "ingest still -o maps --rise 4 --every 20 --json"))
    world = read_world(here / "room.xml")
    assert counts["scans"] > 20
    assert counts["scans_without_overlap"] == counts["scans_without_pose"] == 0
    voxels = read_place(here / "maps" / "place-000.npz").voxels
    free, occupied = voxels.states == 1, voxels.states == 2
    solid, surface = (
        world.truth(GridSpec(shape=free.shape, hollow=hollow), voxels.origin)["occupancy"]
        for hollow in (False, True)
    )
    assert not (solid & ~surface & free).any()
    assert occupied.sum() > 1000
    assert solid[occupied].all()
    assert counts["moved_voxels"] < 0.05 * occupied.sum()
    seen = sorted((here / "maps" / "observations").glob("*.npz"))
    assert [path.stem for path in seen] == [f"{20 * n:06d}" for n in range(len(seen))]
    for sample in map(np.load, seen):
        assert not (sample["observed"] & sample["free"]).any()
        assert sample["known"][sample["occupancy"]].all()
        truth = world.truth(GridSpec(), sample["origin"])["occupancy"]
        assert truth[sample["observed"]].all()
        assert sample["occupancy"][sample["observed"]].mean() > 0.9


def test_what_a_moving_sensor_tells_is_put_right_by_its_times(here, capsys, ros):
    (here / "mine.toml").write_text(f"{SENSOR}lever_arm_m = [1, 0, 0]")
    for name in ("raw.mcap", "right"):
        done(capsys, f"{RECORD} --length 4 --seed 5 --moving -o {name} --quiet")

    def points(name, deskew):
        out = here / f"{name}-{deskew}"
        ingest(read_log(here / name), out, Fusing(every=7, deskew=deskew))
        return [np.load(path)["points"] for path in sorted((out / "observations").glob("*"))]

    right = points("right", False)
    for one, other in zip(points("raw.mcap", True), right, strict=True):
        assert abs(one - other).max() < 0.005
    assert abs(points("raw.mcap", False)[-1] - right[-1]).max() > 0.05


def test_scans_of_a_pattern_that_does_not_repeat_follow_each_other(here):
    world, pose = read_world(here / "room.xml"), Pose.level((0, 0, 1.5))
    caster, long = world.caster(AnalyticEngine.of), dataclasses.replace(MID_360, window_s=0.2)
    one, other = record(world, AnalyticEngine.of, MID_360, [pose] * 2, Noise(), seed=0)
    seen = pose.to_body(cast(caster, long, pose).points())
    assert np.concatenate([one.points, other.points]) == pytest.approx(seen, abs=1e-5)
    assert other.time_s == 0.1


def tilted(count=5):
    """Scans at tilted poses."""
    rng = np.random.default_rng(0)
    for n in range(count):
        turn = rng.normal(size=4)
        pose = Pose(rng.uniform(-3, 3, 3), turn / np.linalg.norm(turn))
        yield LogScan(2.0 + n / 2, pose, rng.uniform(-9, 9, (40, 3)).astype("f4").astype("f8"))


def written(folder, count=5):
    """The scans of a small log, written to `folder`."""
    write_log(folder, scans := [*tilted(count)])
    return scans


def clouds_in(folder, scans, names):
    """A folder of their clouds by these names, without poses."""
    folder.mkdir()
    for scan, name in zip(scans, names, strict=True):
        write_points(folder / f"{name}.ply", scan.points, None, {})
    return folder


def close(log, scans, atol=1e-8):
    pairs = zip(log.scans(), scans, strict=True)
    return all(
        np.allclose(matrix_of(one.pose), matrix_of(other.pose), atol=atol)
        and np.array_equal(one.points, other.points)
        and one.time_s == pytest.approx(other.time_s)
        for one, other in pairs
    )


def test_every_layout_of_a_log_reads_back(tmp_path):
    log, poses = tmp_path / "log", tmp_path / "log" / "poses.tum"
    scans = written(log)
    assert close(read_log(log), scans)
    refuses("a topic", read_log, log, topic="/points")
    # more poses than clouds: found by time, those beyond the last one left out
    times_s = [*(scan.time_s for scan in scans[:4]), 9.0]
    late = read_log(clouds_in(tmp_path / "clouds", scans, times_s), poses=poses)
    assert late.without_pose == 1
    assert close(late, scans[:4])


@pytest.mark.parametrize("form", ["two.bag", "bag", "bag/bag.db3"])
def test_recordings_of_either_ros_say_the_same(tmp_path, form, ros):
    from rosbags.convert import convert
    from rosbags.typesys import Stores, get_typestore

    scans = written(tmp_path / "log.mcap")
    types = get_typestore(Stores.ROS1_NOETIC) if form.endswith(".bag") else None
    source, out, chosen = tmp_path / "log.mcap", tmp_path / form.partition("/")[0], ((), (), (), ())
    convert([source], out, "sqlite3", 9, None, "message", None, types, *chosen)
    assert close(read_log(tmp_path / form), scans)


def log_of(scans):
    """A log in memory."""
    times, poses = np.array([scan.time_s for scan in scans]), tuple(scan.pose for scan in scans)
    return Log(times, poses, 0, lambda first: iter(scans[first:]))


def test_what_moves_on_is_free_and_jumps_are_counted(tmp_path):
    """A wall that is seen 100 times, something before it that is seen twice, and a jump."""
    wall = 6.03 * Lidar().directions_body.reshape(-1, 3)
    near = np.where(np.arange(len(wall))[:, None] % 2, wall, 0.5 * wall)
    here, far = Pose.level((0.0, 0.0, 0.0)), Pose.level((40.0, 0.0, 0.0))
    clouds = [(here, near if n in (5, 90) else wall) for n in range(100)] + [(far, wall)]
    scans = [
        LogScan(n / 10, pose, np.concatenate([points, [[np.nan] * 3, [0, 0, 0.01]]]))
        for n, (pose, points) in enumerate(clouds)
    ]
    counts = ingest(log_of(scans), tmp_path / "maps", Fusing(every=100))
    assert (counts["scans_without_overlap"], counts["returns_left_out"]) == (1, 2 * 101)
    assert counts["moved_voxels"] > 100
    assert 0 <= counts["returns_outside_truth"] < counts["observed_returns"]
    voxels = read_place(tmp_path / "maps" / "place-000.npz").voxels
    occupied = np.argwhere(voxels.states == 2) * 0.2 + voxels.origin + 0.1
    both = [np.linalg.norm(occupied - pose.position, axis=1) for pose in (here, far)]
    off = abs(np.minimum(*both) - 6.03)
    assert (off < 0.2).mean() > 0.999  # but for a ray along the voxels' faces


@pytest.mark.parametrize(("beside", "states"), [(True, [2, 2, 1]), (False, [1, 2, 1])])
def test_free_beside_a_return_says_nothing_against_another(beside, states):
    """A voxel with one hit, and two to its side, free in fifty scans; a return lies between them,
    or far off."""
    hits, misses = np.zeros((2, 9, 9, 9), np.uint8)
    once, often, never = (1, 1, 1), (1, 2, 1) if beside else (7, 7, 7), (1, 3, 1)
    for n in range(51):
        seen = unknown_grid(GridSpec(shape=(9, 9, 9)), np.zeros(3))
        seen.observed[often if n else once] = True
        seen.free[once] = seen.free[never] = n > 0
        _count(hits, misses, np.zeros(3, int), seen)
    _settle(hits, misses, 0.2)
    assert [hits[cell] for cell in (once, often, never)] == states


NEAR = Fusing(every=2, reach_m=10, rise_m=5)
"""Maps of less than a million voxels."""


def ingest_and_be_killed(log, out, at):
    """SIGKILL at a scan, with every scan saved."""
    scenegen.logs.fuse.SAVE_EVERY_S = -1.0
    seen = itertools.count(-1)  # the first call says how many are done already

    def count(_):
        if next(seen) == at:
            os.kill(os.getpid(), signal.SIGKILL)

    ingest(read_log(log), out, NEAR, on_done=count)


def test_a_killed_ingest_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    """Of a place that takes several maps."""
    monkeypatch.setattr(scenegen.logs.fuse, "MAX_PLACE_VOXELS", 800_000)
    log, whole, out, mended = (tmp_path / name for name in ("log", "whole", "out", "mended"))
    written(log, 12)
    counts = ingest(read_log(log), whole, NEAR)
    assert counts["maps"] > 1
    for at in (7, 2):  # killed, and killed again
        child = os.fork()
        if not child:
            ingest_and_be_killed(log, out, at)
        assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    assert not out.exists()
    refuses("other options", ingest, read_log(log), out, dataclasses.replace(NEAR, every=3))
    progress = []
    assert ingest(read_log(log), out, NEAR, on_done=progress.append) == counts
    assert progress[0] == 9
    assert not (tmp_path / "out.part").exists()
    cloud = log / "velodyne" / "000008.bin"
    content = cloud.read_bytes()
    cloud.write_bytes(content[:7])
    refuses("damaged", ingest, read_log(log), mended, NEAR)
    cloud.write_bytes(content)
    assert ingest(read_log(log), mended, NEAR) == counts
    assert contents(out) == contents(mended) == contents(whole)


@each_case("logs/logs", "case file content")
def test_damaged_logs_end_in_one_line_and_leave_nothing(tmp_path, case, file, content):
    log = tmp_path / "log"
    written(log)
    if content == "gone":
        (log / file).rename(tmp_path / "aside")
    else:
        (log / file).write_text(content.replace(";", "\n"))
    refuses(case, lambda: ingest(read_log(log), tmp_path / "out", Fusing()))
    assert names(tmp_path) <= {"log", "aside"}


def test_what_poses_are_of_is_said_or_asked_for(tmp_path):
    """A camera that looks forward: x right, y down, z forward."""
    log, poses = tmp_path / "sequences/00", tmp_path / "poses/00.txt"  # as KITTI's archives have it
    for path in (log, poses):
        path.parent.mkdir()
    scans = written(log)
    # the sensor, .3 m behind the camera and .1 m above it, in the camera's frame
    camera = np.array([[0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.3], [0, 0, 0, 1]])
    of_camera = camera @ [matrix_of(scan.pose) for scan in scans] @ np.linalg.inv(camera)
    np.savetxt(poses, of_camera[:, :3].reshape(-1, 12))
    images = "P0: 7 0 0 0 0 7 0 0 0 0 1 0\nP1: 7 0 0 1 0 7 0 0 0 0 1 0\n"  # as with KITTI's images
    (log / "calib.txt").write_text(images)
    assert close(read_log(log, poses_of="sensor"), scans)
    refuses("no Tr", read_log, log, poses=poses, poses_of="camera")
    row = " ".join(map(str, camera[:3].reshape(-1)))
    (log / "calib.txt").write_text(f"{images}Tr: {row}\n")
    assert close(read_log(log, poses=poses, poses_of="camera"), scans)
    assert close(read_log(log, poses_of="sensor"), scans)
    assert close(read_log(log, poses=log / "poses.tum"), scans)
    refuses("not said", read_log, log, poses=poses)
    (log / "poses.txt").unlink()
    found = read_log(log)
    assert close(found, scans)
    assert found.about["poses"] == "poses of the camera, moved by Tr, from 00.txt"


NAMED = {
    "ns": "{s}{us:06d}000",
    "µs": "{s}{us:06d}",
    "padded": "{s}_{us:06d}000",
    "point": "{s}.{us:06d}",
    "nuScenes": "n008-2018__LIDAR_TOP__{s}{us:06d}",
}


@pytest.mark.parametrize("form", NAMED)
@pytest.mark.parametrize("begin_s", [1_700_000_000, 3_000])
def test_clouds_named_by_any_unit_find_poses_in_seconds(tmp_path, form, begin_s):
    """There is a pose more than clouds, so that they are found by time."""
    after_s = begin_s + 0.12345  # as finely as poses.tum has it
    scans = [dataclasses.replace(scan, time_s=after_s + scan.time_s) for scan in tilted(6)]
    write_log(tmp_path / "log", scans)
    times_us = (divmod(round(1e6 * scan.time_s), 10**6) for scan in scans[:5])
    names = [NAMED[form].format(s=seconds, us=microseconds) for seconds, microseconds in times_us]
    clouds, poses = clouds_in(tmp_path / "clouds", scans[:5], names), tmp_path / "log" / "poses.tum"
    assert close(read_log(clouds, poses=poses), scans[:5], atol=1e-5)
    if form == "padded":
        (clouds / f"{names[0]}.ply").rename(clouds / f"{begin_s + 3}_5.ply")
        refuses(begin_s, read_log, clouds, poses=poses)


@pytest.mark.parametrize("form", ["scan_{:03d}", "{:06d}"])
def test_clouds_of_other_names_have_poses_in_order(tmp_path, form):
    scans, poses = written(tmp_path / "log"), tmp_path / "log" / "poses.tum"
    clouds = clouds_in(tmp_path / "clouds", scans, map(form.format, range(5)))
    assert close(read_log(clouds, poses=poses), scans)
    (clouds / f"{form.format(4)}.ply").unlink()
    refuses("a cloud too few", read_log, clouds, poses=poses)


@pytest.mark.parametrize("case", ["a point 300 km away", "1e3", "nan"])
def test_a_log_without_points_of_a_sensor_makes_no_maps(tmp_path, case):
    scans, log = [*tilted()], tmp_path / "log"
    if case == "a point 300 km away":
        scans[4].points[9, 2] = 3e5
    else:
        scans = [dataclasses.replace(scan, points=float(case) * scan.points) for scan in scans]
    write_log(log, scans)
    refuses(case, lambda: ingest(read_log(log), tmp_path / "out", Fusing()))
    assert not (tmp_path / "out").exists()


def write_livox(path, scans, missing=0):
    """Puts scans into CustomMsg, and their poses into transforms; `missing` more points are
    promised."""
    bag, frame = Bag(), "livox_frame"
    for scan in scans:
        rows = zip(scan.points, scan.more["t"], strict=True)
        points = [{"offset_time": round(1e9 * t), **named("xyz", point)} for point, t in rows]
        counts = {"timebase": round(scan.time_s * 1e9), "point_num": len(points) + missing}
        bag.add("/livox/lidar", scan.time_s, LIVOX[0], frame, points=points, **counts)
        turn = np.roll(scan.pose.quaternion, -1)
        bag.transform(scan.time_s, frame, "map", scan.pose.position, turn)
    bag.write(path)


def test_livox_s_own_messages_are_read(tmp_path, ros):
    times = np.linspace(0, 0.1, 40)
    scans = [dataclasses.replace(scan, more={"t": times}) for scan in written(tmp_path / "log")]
    write_livox(tmp_path / "livox.mcap", scans)
    log = read_log(tmp_path / "livox.mcap")
    assert close(log, scans)
    for scan in log.scans():
        assert scan.more["t"] == pytest.approx(times, abs=1e-9)
    write_livox(tmp_path / "short.mcap", scans, missing=1)
    refuses("a point too few", lambda: list(read_log(tmp_path / "short.mcap").scans()))


@pytest.mark.parametrize("cut", [0, 20, 1000, -1])
def test_cut_recordings_end_in_one_line(tmp_path, cut, ros):
    path = tmp_path / "cut.mcap"
    written(path)
    path.write_bytes(path.read_bytes()[:cut])
    refuses(cut, lambda: list(read_log(path).scans()))


@each_case("logs/logs_bad_use", "words")
def test_bad_use_is_told(capsys, words):
    refuses_command(capsys, words)
