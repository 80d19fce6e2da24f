"""Files of poses: forms are told apart by header and content."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarsim.pose import rotate
from scenegen.worlds.poses import read_poses
from tests.scenegen import refuses

BEGIN_S = 1_700_000_000


def table(level=True, count=5):
    """Times, positions, quaternions x y z w (n, 8) of a sensor that turns; and its rotations."""
    rng = np.random.default_rng(0)
    tilt = 0.02 if level else 1.0
    angles = np.stack([np.linspace(0.1, 3, count), *rng.normal(0, tilt, (2, count))], axis=1)
    turns = Rotation.from_euler("ZYX", angles)
    times = BEGIN_S + 0.5 * np.arange(count)
    return np.column_stack([times, rng.uniform(-9, 9, (count, 3)), turns.as_quat()]), turns


EUROC = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],"
    "q_RS_z [],v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1]"
)
FORMS = {
    "tum": ("", "", "0 1 2 3 4 5 6 7", 1),
    "tum with prose": (
        "# ground truth trajectory\n# file: room.bag\n# timestamp tx ty tz qx qy qz qw",
        *("", "0 1 2 3 4 5 6 7", 1),
    ),
    "w first": ("# t x y z qw qx qy qz", "", "0 1 2 3 7 4 5 6", 1),
    "ns": ("", "", "0 1 2 3 4 5 6 7", 1e9),
    "µs": ("", "", "0 1 2 3 4 5 6 7", 1e6),
    "EuRoC": (EUROC, ",", "0 1 2 3 7 4 5 6 1 1 1", 1e9),
    "csv": ("time_s,pos_x,pos_y,pos_z,q_w,q_x,q_y,q_z,more", ",", "0 1 2 3 7 4 5 6 1", 1),
    "csv of messages": (
        "stamp,pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,"
        "pose.orientation.y,pose.orientation.z,pose.orientation.w,twist.linear.x",
        *(",", "0 1 2 3 4 5 6 7 1", 1),
    ),
    "csv in ms": ("t[ms],x,y,z,qx,qy,qz,qw", ",", "0 1 2 3 4 5 6 7", 1e3),
}
"""Header, what is between columns, these (of t x y z qx qy qz qw), and times for a second."""


def write(path, header, between, columns, scale, rows):
    rows = rows[:, list(map(int, columns.split()))]
    rows[:, 0] *= scale
    np.savetxt(path, rows, "%.12f", between or " ", header=header, comments="")


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_poses(tmp_path, form):
    rows, turns = table()
    write(tmp_path / "poses", *FORMS[form], rows)
    track = read_poses(tmp_path / "poses")
    assert track.times_s == pytest.approx(rows[:, 0], abs=1e-6, rel=0)
    for n, pose in enumerate(track.poses):
        assert pose.position == pytest.approx(rows[n, 1:4])
        assert np.allclose(rotate(pose.quaternion, np.eye(3)).T, turns[n].as_matrix())


HEADS = {
    "#sec,nsec,x,y,z,qx,qy,qz,qw": "",
    "header.stamp.sec,header.stamp.nanosec,header.frame_id,pose.position.x,pose.position.y,"
    "pose.position.z,orientation.x,orientation.y,orientation.z,orientation.w": "map,",
}


@pytest.mark.parametrize("header", HEADS)
def test_nanoseconds_apart_and_words_in_other_columns(tmp_path, header):
    """As Newer College has them, and as `ros2 topic echo --csv` does."""
    rows, _ = table()
    lines = [header]
    for time_s, *pose in rows.tolist():
        lines.append(f"{int(time_s)},{500_000_000 * (time_s % 1 > 0) + 7},{HEADS[header]}")
        lines[-1] += ",".join(map(repr, pose))
    (tmp_path / "poses.csv").write_text("\n".join(lines))
    track = read_poses(tmp_path / "poses.csv")
    assert track.times_s == pytest.approx(rows[:, 0] + 7e-9, abs=1e-6, rel=0)
    assert np.allclose([pose.position for pose in track.poses], rows[:, 1:4])
    lines[3] = lines[3].replace(repr(rows[2, 1].item()), "none")
    (tmp_path / "poses.csv").write_text("\n".join(lines))
    refuses(r"(row 3|line 4): .*finite numbers", read_poses, tmp_path / "poses.csv")


def test_matrices_are_told_from_columns(tmp_path):
    rows, turns = table(level=False)
    matrices = np.concatenate([turns.as_matrix(), rows[:, 1:4, None]], axis=2)
    np.savetxt(tmp_path / "poses", matrices.reshape(-1, 12), header="r11 r12 r13 tx r21 and so on")
    track = read_poses(tmp_path / "poses")
    assert not track.is_timed
    for n, pose in enumerate(track.poses):
        assert np.allclose(rotate(pose.quaternion, np.eye(3)).T, turns[n].as_matrix())


def test_an_order_that_would_tilt_a_level_sensor_is_asked_for(tmp_path):
    rows, _ = table()
    write(tmp_path / "poses", "", "", "0 1 2 3 7 4 5 6", 1, rows)
    refuses("as w x y z they keep it level; name the columns", read_poses, tmp_path / "poses")
    write(tmp_path / "poses", "", "", "0 1 2 3 4 5 6 7", 1, table(level=False)[0])
    assert len(read_poses(tmp_path / "poses").poses) == 5


REFUSED = {
    "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1": "row 2: expected a time above",
    "0 0 0 0 0 0 0 1\n1e8 0 0 0 0 0 0 1": r"times are 1e\+08 apart .* name the unit",
    "1 0 0 0 0 0 0 0.5": "row 1: expected a quaternion of length 1",
    "1 2 3 4 5 6 7 8 9": "9 columns without names",
    "# id x y z qw qx qy qz\n1 0 0 0 1 0 0 0": "8 columns without t",
    "t,time,x,y,z,qx,qy,qz,qw,q_w\n1 1 0 0 0 0 0 0 1 1": None,
    "time,stamp,x,y,z,qx,qy,qz,qw\n1 1 0 0 0 0 0 0 1": "several columns for t",
}


@pytest.mark.parametrize("content", REFUSED)
def test_what_can_be_read_in_two_ways_is_refused(tmp_path, content):
    (tmp_path / "poses").write_text(content)
    if REFUSED[content] is None:  # names as ours go before others
        assert read_poses(tmp_path / "poses").poses[0].quaternion.tolist() == [1, 0, 0, 0]
        return
    refuses(REFUSED[content], read_poses, tmp_path / "poses")


def test_times_of_any_pace_do_if_none_are_needed(tmp_path):
    (tmp_path / "poses").write_text("0 1 2 3 0 0 0 1\n900 4 5 6 0 0 0 1")
    refuses("900 apart", read_poses, tmp_path / "poses")
    assert read_poses(tmp_path / "poses", timed=False).poses[1].position.tolist() == [4, 5, 6]
