"""Real recordings become logs: turned upright, and in the right hand."""

import runpy
from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image

from lidarsim.pose import rotate
from scenegen.logs.read import read_log

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "recordings.py"


def written(recording, source, out, monkeypatch):
    """The points of all scans in the log's world, (n, 3)."""
    monkeypatch.syspath_prepend(SCRIPT.parent)
    monkeypatch.setattr("sys.argv", [str(SCRIPT), recording, str(source), str(out)])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    scans = read_log(out).scans()
    return np.concatenate(
        [scan.pose.position + rotate(scan.pose.quaternion, scan.points) for scan in scans]
    )


def test_a_floor_seen_from_above_is_level(tmp_path, monkeypatch):
    focal, tilt, height = 585.0, np.radians(25), 1.4
    (tmp_path / "camera-intrinsics.txt").write_text(f"{focal} 0 320\n0 {focal} 240\n0 0 1\n")
    down = (np.arange(480) - 240) / focal
    # of a camera that looks down by the tilt, x right, y down and z forward
    sinking = np.sin(tilt) + down * np.cos(tilt)
    depth = np.where(sinking > 0.1, height / np.maximum(sinking, 0.1), 0)
    picture = np.repeat(1000 * depth[:, None], 640, axis=1).astype(np.uint16)
    Image.fromarray(picture).save(tmp_path / "frame-000000.depth.png")
    (tmp_path / "frame-000000.pose.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")

    points = written("room", tmp_path, tmp_path / "log", monkeypatch)

    assert len(points) > 5000
    assert abs(points[:, 2] + height).max() < 0.05


def test_turns_of_left_handed_axes_are_turned_round(tmp_path, monkeypatch):
    (tmp_path / "scan000.3d").write_text("0 0 100\n0 50 100\n0 0 3276\n")
    (tmp_path / "scan000.pose").write_text("0 0 200\n0 90 0\n")

    points = written("laser", tmp_path, tmp_path / "log", monkeypatch)

    # what was ahead is to the right now; what is farther than a scanner sees is left out
    assert np.allclose(points, [[2, -1, 0], [2, -1, 0.5]], atol=1e-6)


def test_what_two_sweeps_drop_is_counted_against_labels_of_flow(tmp_path, monkeypatch, capsys):
    """A wall at 6 m, and 50 points at 3 m which are gone in the second sweep."""
    across, up = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(-1.9, 2, 0.04)]))
    wall = np.stack([np.full(len(up), 6.03), across, up], axis=1)
    sweeps = [np.concatenate([wall[:50] / 2, wall[50:]]), wall]
    (tmp_path / "sensors" / "lidar").mkdir(parents=True)
    (tmp_path / "calibration").mkdir()
    place = dict.fromkeys(("tx_m", "ty_m", "tz_m", "qx", "qy", "qz"), 0.0) | {"qw": 1.0}
    for time, points in enumerate(sweeps):
        table = pd.DataFrame(points, columns=list("xyz"))
        table.to_feather(tmp_path / "sensors" / "lidar" / f"{time}.feather")
    track = pd.DataFrame([{"timestamp_ns": time, **place} for time in range(2)])
    track.to_feather(tmp_path / "city_SE3_egovehicle.feather")
    mount = pd.DataFrame([{"sensor_name": "up_lidar", **place}])
    mount.to_feather(tmp_path / "calibration" / "egovehicle_SE3_sensor.feather")
    moves = pd.DataFrame({"dynamic": np.arange(len(wall)) < 50})
    moves.to_feather(tmp_path / "flow_labels.feather")

    written("flow", tmp_path, tmp_path / "log", monkeypatch)

    *_, half, more = capsys.readouterr().out.splitlines()
    assert ", 50 move, 0 dropped" in half
    assert ", 50 move, 50 dropped, 50 both" in more
