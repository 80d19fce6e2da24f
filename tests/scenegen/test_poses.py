"""Files of poses: forms are told apart by header and content."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarsim.pose import rotate
from scenegen.worlds.poses import read_poses
from tests.refusals import refuses
from tests.scenegen import cases, each_case

BEGIN_S = 1_700_000_000


def table(level=True, count=5):
    """Times, positions, quaternions x y z w (n, 8) of a sensor that turns; and its rotations."""
    rng = np.random.default_rng(0)
    tilt = 0.02 if level else 1.0
    angles = np.stack([np.linspace(0.1, 3, count), *rng.normal(0, tilt, (2, count))], axis=1)
    turns = Rotation.from_euler("ZYX", angles)
    times = BEGIN_S + 0.5 * np.arange(count)
    return np.column_stack([times, rng.uniform(-9, 9, (count, 3)), turns.as_quat()]), turns


def write(path, rows, header="", between="", columns="0 1 2 3 4 5 6 7", scale=1):
    rows = rows[:, list(map(int, columns.split()))]
    rows[:, 0] *= float(scale)
    header = header.replace("; ", "\n")
    np.savetxt(path, rows, "%.12f", between or " ", header=header, comments="")


def matrices_of(track):
    return np.array([rotate(pose.quaternion, np.eye(3)).T for pose in track.poses])


@pytest.mark.parametrize("form", cases("poses"), ids=lambda form: form[0])
def test_every_form_gives_the_same_poses(tmp_path, form):
    rows, turns = table()
    write(tmp_path / "poses", rows, *form[1:])
    track = read_poses(tmp_path / "poses")
    assert track.times_s == pytest.approx(rows[:, 0], abs=1e-6, rel=0)
    assert np.allclose([pose.position for pose in track.poses], rows[:, 1:4])
    assert np.allclose(matrices_of(track), turns.as_matrix())


HEADS = {
    "#sec,nsec,x,y,z,qx,qy,qz,qw": "",
    "header.stamp.sec,header.stamp.nanosec,header.frame_id,pose.position.x,pose.position.y,"
    "pose.position.z,orientation.x,orientation.y,orientation.z,orientation.w": "map,",
}


@pytest.mark.parametrize("header", HEADS)
def test_nanoseconds_apart_and_words_in_other_columns(tmp_path, header):
    """As Newer College has them, and as `ros2 topic echo --csv` does."""
    rows, _ = table()
    file, lines = tmp_path / "poses.csv", [header]
    for time_s, *pose in rows.tolist():
        nanoseconds = 500_000_000 * (time_s % 1 > 0) + 7  # whose zeros are not written
        numbers = ",".join(map(repr, pose))
        lines.append(f"{int(time_s)},{nanoseconds},{HEADS[header]}{numbers}")
    file.write_text("\n".join(lines))
    track = read_poses(file)
    assert track.times_s == pytest.approx(rows[:, 0], abs=1e-6, rel=0)
    assert np.allclose([pose.position for pose in track.poses], rows[:, 1:4])
    file.write_text("\n".join(lines).replace(repr(rows[2, 1].item()), "none"))
    refuses(header, read_poses, file)


def test_matrices_are_told_from_columns(tmp_path):
    rows, turns = table(level=False)
    matrices = np.concatenate([turns.as_matrix(), rows[:, 1:4, None]], axis=2)
    np.savetxt(tmp_path / "poses", matrices.reshape(-1, 12), header="r11 r12 r13 tx r21 and so on")
    track = read_poses(tmp_path / "poses")
    assert not track.is_timed
    assert np.allclose(matrices_of(track), turns.as_matrix())


def test_an_order_that_would_tilt_a_level_sensor_is_asked_for(tmp_path):
    rows, _ = table()
    write(tmp_path / "poses", rows, columns="0 1 2 3 7 4 5 6")
    refuses("w first", read_poses, tmp_path / "poses")
    write(tmp_path / "poses", table(level=False)[0])
    assert len(read_poses(tmp_path / "poses").poses) == 5


@each_case("poses_refused", "content")
def test_what_can_be_read_in_two_ways_is_refused(tmp_path, content):
    (tmp_path / "poses").write_text(content.replace("; ", "\n"))
    refuses(content, read_poses, tmp_path / "poses")


def test_names_as_ours_go_before_others(tmp_path):
    (tmp_path / "poses").write_text("t,time,x,y,z,qx,qy,qz,qw,q_w\n1 1 0 0 0 0 0 0 1 1")
    assert read_poses(tmp_path / "poses").poses[0].quaternion.tolist() == [1, 0, 0, 0]


def test_a_comment_below_a_row_names_no_columns(tmp_path):
    rows = "0 1 2 3 0 0 0 1", "# t x y z qw qx qy qz", "1 1 2 3 0 0 0 1"
    (tmp_path / "poses").write_text("\n".join(rows))
    assert read_poses(tmp_path / "poses").poses[0].quaternion.tolist() == [1, 0, 0, 0]


def test_times_of_any_pace_do_if_none_are_needed(tmp_path):
    (tmp_path / "poses").write_text("0 1 2 3 0 0 0 1\n900 4 5 6 0 0 0 1")
    refuses("900 s", read_poses, tmp_path / "poses")
    assert read_poses(tmp_path / "poses", timed=False).poses[1].position.tolist() == [4, 5, 6]
