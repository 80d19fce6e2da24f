"""Frames of recordings: one tree, or a refusal that names both parents."""

import dataclasses
import math

import numpy as np
import pytest

from scenegen.logs.read import read_log
from tests.command_line import done, refused, run
from tests.conftest import contents
from tests.scenegen import refuses
from tests.scenegen.logs.bags import BEGIN_S, PERIOD_S, SPEED_MPS, drive, moving

MAP_M = 16.9
"""How far the origin of `odom` is from that of `map`, along y."""


def positions(log):
    return np.array([pose.position for pose in log.poses])


def along_x(y=0.0, scans=6):
    """Where the sensor of `drive` was."""
    return [[SPEED_MPS * PERIOD_S * n, y, 0] for n in range(scans)]


def two_parents(bag):
    """`base` hangs from `odom` and from `map`, in turn."""
    bag.transform(BEGIN_S, "lidar", "base", (0, 0, 0), topic="/tf_static")
    moving(bag, child="base", parent="odom")
    for n in range(13):
        time_s = BEGIN_S + PERIOD_S * (n / 2 - 0.1)
        place = (SPEED_MPS * (time_s - BEGIN_S), MAP_M, 0)
        bag.transform(time_s, "base", "map", place)


def test_a_frame_with_two_parents_is_refused_or_one_followed(tmp_path, capsys):
    bag, _ = drive()
    two_parents(bag)
    path = bag.write(tmp_path / "bag")
    line = refused(capsys, f"ingest {path} -o {tmp_path}/out --quiet")
    assert "/tf says where 'base' is in 'map' and in 'odom'" in line
    assert "--fixed-frame" in line
    for frame, y in (("odom", 0.0), ("map", MAP_M)):
        log = read_log(path, fixed_frame=frame)
        assert positions(log) == pytest.approx(np.array(along_x(y)), abs=1e-6)
        assert log.about["poses"] == f"poses in {frame} by /tf_static and /tf"
    refuses("'base' is in 'map' and in 'odom'", read_log, path, fixed_frame="earth")


def test_clouds_of_several_frames_are_refused(tmp_path):
    bag, _ = drive()
    bag.messages += drive(frame="rear")[0].messages
    path = moving(moving(bag, child="rear", parent="odom")).write(tmp_path / "bag")
    refuses("/points are of several frames, lidar, rear; expected", read_log, path)


def test_frames_in_a_circle_and_unknown_ones_are_named(tmp_path):
    bag, _ = drive()
    moving(moving(bag, child="map", parent="lidar"))
    path = bag.write(tmp_path / "bag")
    refuses("'lidar' hangs from itself, by /tf", read_log, path)
    refuses("is the frame of its clouds", read_log, path, fixed_frame="lidar")
    assert read_log(path, fixed_frame="map").about["poses"] == "poses in map by /tf"
    bag, _ = drive(frame="radar")
    refuses(
        r"where 'radar' is, .* speak of 'lidar'; .* --poses",
        lambda: read_log(moving(bag).write(tmp_path / "other")),
    )
    refuses(
        "'lidar' does not hang from --fixed-frame 'earth'",
        lambda: read_log(moving(drive()[0]).write(tmp_path / "one"), fixed_frame="earth"),
    )


def test_a_transform_for_ever_that_changes_is_refused(tmp_path):
    bag, _ = drive()
    moving(bag, child="base")
    for n, x in enumerate((0.5, 0.5, 0.7)):
        bag.transform(BEGIN_S + n, "lidar", "base", (x, 0, 0), topic="/tf_static")
        path = bag.write(tmp_path / f"bag{n}")
        if n < 2:
            assert positions(read_log(path))[0] == pytest.approx([0.5, 0, 0])
    refuses("/tf_static says twice, and not the same", read_log, path)


def test_odometry_may_begin_with_zeros(tmp_path):
    bag, _ = drive()
    for n in range(-3, 7):
        place = (SPEED_MPS * PERIOD_S * n, 0, 0)
        turn = (0, 0, 0, float(n >= 0))
        bag.odometry(BEGIN_S + PERIOD_S * n, "lidar", "odom", place, turn)
    assert positions(read_log(bag.write(tmp_path / "bag"))) == pytest.approx(np.array(along_x()))
    bag.odometry(BEGIN_S + 0.45, "lidar", "odom", (4.5, 0, 0), (0, 0, 0, 0))
    refuses(
        "/odom: 'lidar': row 6: expected a quaternion",
        lambda: read_log(bag.write(tmp_path / "lost")),
    )


def test_a_single_row_may_leave_out_its_length(tmp_path):
    bag, truth = drive(row_step=0)
    scans = list(read_log(moving(bag).write(tmp_path / "bag")).scans())
    assert len(scans) == 6
    assert scans[3].points[0] == pytest.approx(truth[3][0], abs=1e-6)
    *where, cloud = bag.messages[0]
    bag.messages[0] = (*where, dataclasses.replace(cloud, point_step=0))
    odd = bag.write(tmp_path / "odd")
    refuses("expected points of 12 or more", lambda: list(read_log(odd).scans()))


def test_a_pose_is_the_chain_of_its_frames_between_their_times(tmp_path):
    bag, _ = drive()
    bag.transform(BEGIN_S, "lidar", "base", (1, 0, 0), (0, 0, 0.707, 0.707), topic="/tf_static")
    for n, yaw in ((0, 0.0), (6, 1.2)):
        turn = (0, 0, math.sin(yaw / 2), math.cos(yaw / 2))
        bag.transform(BEGIN_S + n * PERIOD_S, "base", "odom", (n, 0, 0), turn)
    pose, half = read_log(bag.write(tmp_path / "bag")).poses[3], 0.3 + math.pi / 4
    assert pose.position == pytest.approx([3 + math.cos(0.6), math.sin(0.6), 0])
    assert pose.quaternion == pytest.approx([math.cos(half), 0, 0, math.sin(half)])


def test_scans_after_the_last_pose_have_none(tmp_path):
    log = read_log(moving(drive()[0], scans=3).write(tmp_path / "bag"))
    assert (len(log.poses), log.without_pose) == (4, 2)


def tum(n):
    """The line of TUM's for the pose of `drive` at scan n."""
    return f"{BEGIN_S + PERIOD_S * n:.3f} {SPEED_MPS * PERIOD_S * n} 0 0 0 0 0 1\n"


def test_a_bag_without_transforms_takes_poses(tmp_path, capsys):
    path = drive()[0].write(tmp_path / "bag")
    assert "--poses" in refused(capsys, f"ingest {path} -o {tmp_path}/out --quiet")
    (tmp_path / "poses.tum").write_text("".join(map(tum, range(0, 8, 2))))
    kitti = "".join(f"1 0 0 {n} 0 1 0 0 0 0 1 0\n" for n in range(6))
    (tmp_path / "poses.txt").write_text(kitti)
    for name in ("poses.tum", "poses.txt"):
        log = read_log(path, poses=tmp_path / name)
        assert positions(log) == pytest.approx(np.array(along_x()), abs=1e-5)
        assert log.about["poses"] == f"poses of the sensor from {name}"
    (tmp_path / "poses.txt").write_text(kitti[: len(kitti) // 2])
    refuses("3 poses without times, for 6 clouds", read_log, path, poses=tmp_path / "poses.txt")
    (tmp_path / "poses.tum").write_text("".join(f"{n} 0 0 0 0 0 0 1\n" for n in range(9)))
    refuses(
        r"from 1\.7e\+09|from 1700000000 to 1700000000\.5 s",
        read_log,
        path,
        poses=tmp_path / "poses.tum",
    )


def test_a_folder_may_hold_a_recording_alone(tmp_path):
    path = moving(drive()[0]).write(tmp_path / "bag")
    (path / "metadata.yaml").unlink()
    assert positions(read_log(path)) == pytest.approx(np.array(along_x()))
    (path / "bag_1.db3").write_bytes((path / "bag.db3").read_bytes())
    refuses(r"2 recordings and no metadata\.yaml", read_log, path)


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
    assert "lidar in map by /tf" in printed
    assert "0.1 s apart" in printed
    assert "200 points, " in printed
    assert contents(tmp_path) == before
