"""Frames of recordings: one tree, or a refusal that names both parents."""

import math

import numpy as np
import pytest

from scenegen.logs.read import read_log
from tests.command_line import done, run
from tests.conftest import contents
from tests.refusals import refuses, refuses_command
from tests.scenegen.logs.bags import BEGIN_S, PERIOD_S, SPEED_MPS, drive, moving

MAP_M = 16.9
"""How far the origin of `odom` is from that of `map`, along y."""


def positions(log):
    return np.array([pose.position for pose in log.poses])


def along_x(y=0.0):
    """Where the sensor of `drive` was, as pytest compares it."""
    return pytest.approx(np.array([[SPEED_MPS * PERIOD_S * n, y, 0] for n in range(6)]), abs=1e-5)


def two_parents(bag):
    """`base` hangs from `odom` and from `map`, in turn."""
    bag.transform(BEGIN_S, "lidar", "base", (0, 0, 0), topic="/tf_static")
    moving(bag, child="base", parent="odom")
    for n in range(13):
        time_s = BEGIN_S + PERIOD_S * (n / 2 - 0.1)
        place = (SPEED_MPS * (time_s - BEGIN_S), MAP_M, 0)
        bag.transform(time_s, "base", "map", place)


def test_a_frame_with_two_parents_is_refused_or_one_followed(tmp_path):
    bag, _ = drive()
    two_parents(bag)
    path = bag.write(tmp_path / "bag")
    for frame, y in (("odom", 0.0), ("map", MAP_M)):
        log = read_log(path, fixed_frame=frame)
        assert positions(log) == along_x(y)
        assert log.about["poses"] == f"poses in {frame} by /tf_static and /tf"
    for frame in ("", "earth"):
        refuses(frame, read_log, path, fixed_frame=frame)


def test_clouds_of_several_frames_are_refused(tmp_path):
    bag, _ = drive()
    bag.messages += drive(frame="rear")[0].messages
    refuses("lidar and rear", read_log, bag.write(tmp_path / "bag"))


def test_frames_in_a_circle_and_unknown_ones_are_named(tmp_path):
    path = moving(moving(drive()[0], child="map", parent="lidar")).write(tmp_path / "bag")
    refuses("circle", read_log, path)
    refuses("frame of the clouds", read_log, path, fixed_frame="lidar")
    assert read_log(path, fixed_frame="map").about["poses"] == "poses in map by /tf"
    path = moving(drive(frame="radar")[0]).write(tmp_path / "other")
    refuses("clouds of a frame without transforms", read_log, path)
    path = moving(drive()[0]).write(tmp_path / "plain")
    refuses("unknown fixed frame", read_log, path, fixed_frame="earth")


def test_a_transform_for_ever_that_changes_is_refused(tmp_path):
    bag, _ = drive()
    moving(bag, child="base")
    for n, x in enumerate((0.5, 0.5, 0.7)):
        bag.transform(BEGIN_S + n, "lidar", "base", (x, 0, 0), topic="/tf_static")
        path = bag.write(tmp_path / f"bag{n}")
        if n < 2:
            assert positions(read_log(path))[0] == pytest.approx([0.5, 0, 0])
    refuses("another place", read_log, path)


def test_odometry_may_begin_with_zeros(tmp_path):
    bag, _ = drive()
    for n in range(-3, 7):
        place = (SPEED_MPS * PERIOD_S * n, 0, 0)
        turn = (0, 0, 0, float(n >= 0))
        bag.odometry(BEGIN_S + PERIOD_S * n, "lidar", "odom", place, turn)
    assert positions(read_log(bag.write(tmp_path / "bag"))) == along_x()
    bag.odometry(BEGIN_S + 0.45, "lidar", "odom", (4.5, 0, 0), (0, 0, 0, 0))
    refuses("zeros later", read_log, bag.write(tmp_path / "lost"))


def test_a_single_row_may_leave_out_its_length(tmp_path):
    bag, truth = drive(row_step=0)
    scans = list(read_log(moving(bag).write(tmp_path / "bag")).scans())
    assert len(scans) == 6
    assert scans[3].points[0] == pytest.approx(truth[3][0], abs=1e-6)
    bag.messages[0][-1]["point_step"] = 0
    refuses("points of no size", read_log, bag.write(tmp_path / "odd"))


def test_a_pose_is_the_chain_of_its_frames_between_their_times(tmp_path):
    bag, _ = drive()
    bag.transform(BEGIN_S, "lidar", "base", (1, 0, 0), (0, 0, 0.707, 0.707), topic="/tf_static")
    for n, yaw in ((0, 0.0), (6, 1.2)):
        turn = (0, 0, math.sin(yaw / 2), math.cos(yaw / 2))
        bag.transform(BEGIN_S + n * PERIOD_S, "base", "odom", (n, 0, 0), turn)
    pose, half = read_log(bag.write(tmp_path / "bag")).poses[3], 0.3 + math.pi / 4
    assert pose.position == pytest.approx([3 + math.cos(0.6), math.sin(0.6), 0])
    assert pose.quaternion == pytest.approx([math.cos(half), 0, 0, math.sin(half)])


def tum(n):
    """The line of TUM's for the pose of `drive` at scan n."""
    return f"{BEGIN_S + PERIOD_S * n:.3f} {SPEED_MPS * PERIOD_S * n} 0 0 0 0 0 1\n"


def test_a_bag_without_transforms_takes_poses(tmp_path, capsys):
    path = drive()[0].write(tmp_path / "bag")
    refuses_command(capsys, f"ingest {path} -o {tmp_path}/out --quiet")
    kitti = "".join(f"1 0 0 {n} 0 1 0 0 0 0 1 0\n" for n in range(6))
    for name, text in (("tum", "".join(map(tum, range(0, 8, 2)))), ("txt", kitti)):
        (tmp_path / f"poses.{name}").write_text(text)
        log = read_log(path, poses=tmp_path / f"poses.{name}")
        assert positions(log) == along_x()
        assert log.about["poses"] == f"poses of the sensor from poses.{name}"
    other_times = "".join(f"{n} 0 0 0 0 0 0 1\n" for n in range(9))
    for name, text in (("few", kitti[: len(kitti) // 2]), ("other times", other_times)):
        (tmp_path / name).write_text(text)
        refuses(name, read_log, path, poses=tmp_path / name)


def test_a_folder_may_hold_a_recording_alone(tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    moving(drive()[0]).write(folder / "one")
    assert positions(read_log(folder)) == along_x()
    moving(drive()[0]).write(folder / "two")
    refuses("two", read_log, folder)


def test_a_line_says_what_was_read_and_explain_writes_nothing(tmp_path, capsys):
    bag, _ = drive(lambda u, stamp: {"intensity": u.astype("f4"), "t": (u * 1e6).astype("u4")})
    path = moving(bag).write(tmp_path / "bag")
    code, _, error = run(capsys, f"ingest {path} -o {tmp_path}/out --rise 12 --deskew")
    line = (
        "read: 6 clouds on /points, x y z intensity t, frame lidar, poses in map by /tf, times "
        "from field t in µs"
    )
    assert (code, line in error.splitlines()) == (0, True), error
    before = contents(tmp_path)
    printed = done(capsys, f"ingest {path} -o {tmp_path}/out --explain")
    for fact in ("lidar in map by /tf", "0.1 s apart", "200 points, "):
        assert fact in printed
    assert contents(tmp_path) == before
