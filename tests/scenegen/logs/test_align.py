"""Poses of logs without any: found by registering scans, told, and refused where they fail."""

import json

import numpy as np
import pytest

from lidarsim import Pose
from scenegen.base.errors import DatasetError
from scenegen.logs import Fusing, LogScan
from scenegen.logs.align import align
from scenegen.logs.read import read_log
from scenegen.logs.record import matrix_of, write_log
from tests.command_line import done
from tests.refusals import refuses, refuses_command
from tests.scenegen.logs.conftest import RECORD

pytest.importorskip("small_gicp", reason="small-gicp is not installed")


def furthest(log, true):
    """The largest distance between positions, both in the frame of the first, metres."""
    found, known = (np.array([matrix_of(pose) for pose in each.poses]) for each in (log, true))
    return abs((np.linalg.inv(known[0]) @ known - np.linalg.inv(found[0]) @ found)[:, :3, 3]).max()


def test_poses_are_found_and_can_be_used_again(here, capsys):
    done(capsys, f"{RECORD} -o log --quiet")
    counts = json.loads(done(capsys, "ingest log --align -o maps --rise 4 --json"))
    poses, log = here / "maps" / "poses.tum", here / "log"
    assert furthest(read_log(log, poses=poses), read_log(log)) < 0.05
    assert "taken to be level" in counts["read"]["poses"]
    assert counts["scans"] > 20


def test_raw_scans_are_corrected_by_the_motion_that_is_found(here, ros, capsys):
    done(capsys, f"{RECORD} --speed 3 --moving -o raw.mcap --quiet")
    log = align(read_log(here / "raw.mcap", posed=False), Fusing(deskew=True))
    assert log.without_pose == 0
    assert furthest(log, read_log(here / "raw.mcap")) < 0.15


def scan(n, center=(0, 0, 0), count=3000):
    """The inside of a room, from `center`."""
    points = np.random.default_rng(n).uniform(-1, 1, (count, 3))
    points *= (6, 4, 2) / abs(points).max(axis=1, keepdims=True)
    return LogScan(n / 10, Pose.level((0, 0, 0)), np.clip(points, (-6, -4, -2), (6, 4, 2)) - center)


def aligned(folder, scans):
    write_log(folder / "log", scans)
    return align(read_log(folder / "log", posed=False), Fusing())


def test_a_scan_that_fits_nothing_is_left_out_and_counted(tmp_path):
    scans = [scan(n, (0.1 * n, 0, 0)) for n in range(20)]
    scans[7] = scan(7, count=9)
    log = aligned(tmp_path, scans)
    assert (log.without_pose, len(log.poses)) == (1, 19)
    assert [one.time_s for one in log.scans(6)][:2] == pytest.approx([0.6, 0.8])
    assert log.poses[-1].position == pytest.approx((1.9, 0, 0), abs=0.1)


def test_the_error_at_a_place_that_is_seen_again_is_told(tmp_path):
    way = abs(np.arange(-3, 15, 0.5) % 6 - 3)  # to and fro, thrice
    log = aligned(tmp_path, [scan(n, (x, 0, 0)) for n, x in enumerate(way)])
    assert log.about["closing"].startswith("drift at")
    assert float(log.about["closing"].split()[-4]) < 0.1


def test_scans_that_do_not_overlap_are_refused(tmp_path):
    scans = [scan(0), scan(1), scan(2, (40, 0, 0)), scan(3, (80, 0, 0))]
    refuses("apart", aligned, tmp_path, scans)


@pytest.mark.parametrize("more", ["--align --poses log/poses.tum", "--align --deskew", "", "one"])
def test_what_cannot_be_aligned_is_refused(standing, capsys, more):
    write_log(standing / "log", [scan(n) for n in range(1 if more == "one" else 3)])
    (standing / "log" / "poses.txt").unlink()
    refuses_command(capsys, f"ingest log -o out {more.replace('one', '--align')} --quiet", more)
    assert not (standing / "out").exists()


def test_a_corridor_without_ends_is_refused(tmp_path):
    """Every scan of it is the same wherever it is made, so a registration would find no motion."""
    across = np.random.default_rng(0).uniform(-1, 1, (4000, 3)) * (20, 2, 1.5)
    walls = across * [1, 0, 1] + [0, 2, 0] * np.sign(across)
    floors = across * [1, 1, 0] + [0, 0, 1.5] * np.sign(across)
    corridor = np.concatenate([walls[::2], floors[1::2]])
    scans = [LogScan(n / 10, Pose.level((0, 0, 0)), corridor) for n in range(5)]
    refuses("corridor", aligned, tmp_path, scans, error=DatasetError)
