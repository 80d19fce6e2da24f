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


@pytest.fixture
def path(tmp_path):
    return tmp_path / "bag.mcap"


@pytest.fixture
def bag(ros):
    """A recording without poses."""
    return drive()[0]


def positions(log):
    return np.array([pose.position for pose in log.poses])


def along_x(y=0.0):
    """Where the sensor of `drive` was, as pytest compares it."""
    return pytest.approx(np.array([[SPEED_MPS * PERIOD_S * n, y, 0] for n in range(6)]), abs=1e-5)


def test_a_frame_with_two_parents_is_refused_or_one_followed(bag, path):
    """`base` hangs from `odom` and from `map`, in turn."""
    bag.transform(BEGIN_S, "lidar", "base", (0, 0, 0), topic="/tf_static")
    moving(bag, child="base", parent="odom")
    for n in range(13):
        after_s = PERIOD_S * (n / 2 - 0.1)
        bag.transform(BEGIN_S + after_s, "base", "map", (SPEED_MPS * after_s, MAP_M, 0))
    bag.write(path)
    for frame, y in (("odom", 0.0), ("map", MAP_M)):
        log = read_log(path, fixed_frame=frame)
        assert positions(log) == along_x(y)
        assert log.about["poses"] == f"poses in {frame} by /tf_static and /tf"
    for frame in ("", "earth"):
        refuses(frame, read_log, path, fixed_frame=frame)


def test_clouds_of_several_frames_are_refused(bag, path):
    bag.messages += drive(frame="rear")[0].messages
    refuses("lidar and rear", read_log, bag.write(path))


def test_frames_in_a_circle_and_unknown_ones_are_named(bag, path):
    refuses("unknown fixed frame", read_log, moving(bag).write(path), fixed_frame="earth")
    moving(bag, child="map", parent="lidar").write(path)
    refuses("circle", read_log, path)
    refuses("frame of the clouds", read_log, path, fixed_frame="lidar")
    assert read_log(path, fixed_frame="map").about["poses"] == "poses in map by /tf"
    moving(drive(frame="radar")[0]).write(path)
    refuses("clouds of a frame without transforms", read_log, path)


def test_a_transform_for_ever_that_changes_is_refused(bag, path):
    moving(bag, child="base")
    for x in (0.5, 0.5):
        bag.transform(BEGIN_S, "lidar", "base", (x, 0, 0), topic="/tf_static")
    assert positions(read_log(bag.write(path)))[0] == pytest.approx([0.5, 0, 0])
    bag.transform(BEGIN_S + 1, "lidar", "base", (0.7, 0, 0), topic="/tf_static")
    refuses("another place", read_log, bag.write(path))


def test_odometry_may_begin_with_zeros(bag, path):
    for n in range(-3, 7):
        place, turn = (SPEED_MPS * PERIOD_S * n, 0, 0), (0, 0, 0, float(n >= 0))
        bag.odometry(BEGIN_S + PERIOD_S * n, "lidar", "odom", place, turn)
    assert positions(read_log(bag.write(path))) == along_x()
    bag.odometry(BEGIN_S + 0.45, "lidar", "odom", (4.5, 0, 0), (0, 0, 0, 0))
    refuses("zeros later", read_log, bag.write(path))


def test_a_single_row_may_leave_out_its_length(path, ros):
    bag, truth = drive(row_step=0)
    scans = list(read_log(moving(bag).write(path)).scans())
    assert len(scans) == 6
    assert scans[3].points[0] == pytest.approx(truth[3][0], abs=1e-6)
    bag.messages[0][-1]["point_step"] = 0
    refuses("points of no size", read_log, bag.write(path))


def test_a_pose_is_the_chain_of_its_frames_between_their_times(bag, path):
    bag.transform(BEGIN_S, "lidar", "base", (1, 0, 0), (0, 0, 0.707, 0.707), topic="/tf_static")
    for n, yaw in ((0, 0.0), (6, 1.2)):
        turn = (0, 0, math.sin(yaw / 2), math.cos(yaw / 2))
        bag.transform(BEGIN_S + n * PERIOD_S, "base", "odom", (n, 0, 0), turn)
    pose, half = read_log(bag.write(path)).poses[3], 0.3 + math.pi / 4
    assert pose.position == pytest.approx([3 + math.cos(0.6), math.sin(0.6), 0])
    assert pose.quaternion == pytest.approx([math.cos(half), 0, 0, math.sin(half)])


def test_a_bag_without_transforms_takes_poses(bag, path, capsys):
    bag.write(path)
    refuses_command(capsys, f"ingest {path} -o {path.parent}/out --quiet")
    kitti = [f"1 0 0 {n} 0 1 0 0 0 0 1 0\n" for n in range(6)]
    # each second pose: those between are interpolated
    tum = [f"{BEGIN_S + PERIOD_S * n:.3f} {n} 0 0 0 0 0 1\n" for n in range(0, 8, 2)]
    other_times = [f"{n} 0 0 0 0 0 0 1\n" for n in range(9)]
    files = {"tum": tum, "kitti": kitti, "few": kitti[:3], "other times": other_times}
    for name, lines in files.items():
        poses = path.with_name(name)
        poses.write_text("".join(lines))
        if name in ("few", "other times"):
            refuses(name, read_log, path, poses=poses)
            continue
        log = read_log(path, poses=poses)
        assert positions(log) == along_x()
        assert log.about["poses"] == f"poses of the sensor from {name}"


def test_a_folder_may_hold_a_recording_alone(bag, path):
    moving(bag).write(path)
    assert positions(read_log(path.parent)) == along_x()
    bag.write(path.with_name("two"))
    refuses("two", read_log, path.parent)


def test_a_line_says_what_was_read_and_explain_writes_nothing(path, ros, capsys):
    bag, _ = drive(lambda u, stamp: {"intensity": u.astype("f4"), "t": (u * 1e6).astype("u4")})
    command = f"ingest {moving(bag).write(path)} -o {path.parent}/out"
    code, _, error = run(capsys, f"{command} --rise 12 --deskew")
    line = (
        "read: 6 clouds on /points, x y z intensity t, frame lidar, poses in map by /tf, times "
        "from field t in µs"
    )
    assert (code, line in error.splitlines()) == (0, True), error
    before = contents(path.parent)
    printed = done(capsys, f"{command} --explain")
    for fact in ("lidar in map by /tf", "0.1 s apart", "200 points, "):
        assert fact in printed
    assert contents(path.parent) == before
