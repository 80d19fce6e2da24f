"""What is dropped of a real scan is counted against its labels."""

import runpy
from pathlib import Path

import numpy as np
import pandas as pd

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "argoverse.py"


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

    monkeypatch.syspath_prepend(SCRIPT.parent)
    monkeypatch.setattr("sys.argv", [str(SCRIPT), str(tmp_path), str(tmp_path / "log")])
    runpy.run_path(str(SCRIPT), run_name="__main__")

    *_, half, more = capsys.readouterr().out.splitlines()
    assert ", 50 move, 0 dropped" in half
    assert ", 50 move, 50 dropped, 50 both" in more
