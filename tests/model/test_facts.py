"""What `inspect` says of scans, predictions and runs is what is in them."""

import json

import h5py
import numpy as np
from numpy.testing import assert_allclose

from scenegen.display.exchange.files import write_points
from tests.command_line import refused, run


def told(capsys, path):
    code, said, noted = run(capsys, f"inspect {path} --json")
    assert (code, noted) == (0, "")
    return json.loads(said)


def test_a_scan_predictions_and_a_run_are_told(tmp_path, capsys):
    points = np.random.default_rng(0).uniform(-5, 5, (40, 3))
    write_points(tmp_path / "scan.pcd", points, None, {})
    found = told(capsys, tmp_path / "scan.pcd")
    assert (found["points"], found["returns"]) == (40, 40)
    assert_allclose(found["lower_m"], points.min(axis=0), atol=1e-6)
    assert_allclose(found["mean_range_m"], np.linalg.norm(points, axis=1).mean(), atol=1e-6)
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file.attrs.update({"method": "mine\x1b[2J", "split": "test", "dataset": "ab12"})
        file["tudf"] = np.zeros((3, 4, 4, 2), np.float32)
    found = told(capsys, tmp_path / "p.h5")
    assert (found["of"], found["arrays"], found["dataset"]) == (
        "a split",
        {"tudf": [3, 4, 4, 2]},
        "ab12",
    )
    assert "\x1b" not in found["method"]
    run_folder = tmp_path / "run"
    run_folder.mkdir()
    settings = {
        "network": {"variant": "occ", "inputs": ["observed"]},
        "kinds": ["pillar"],
        "samples": 7,
    }
    (run_folder / "config.json").write_text(json.dumps({"settings": settings}))
    rows = [
        "epoch,train_loss,val_loss,val_iou,val_near_mae",
        "1,0.5,0.6,0.4,0.2",
        "2,0.4,0.3,0.5,0.1",
        "3,0.3,0.7,0.6,0.3",
    ]
    (run_folder / "metrics.csv").write_text("\n".join(rows) + "\n")
    found = told(capsys, run_folder)
    assert (found["network"], found["kinds"], found["epochs"]) == ("occ", ["pillar"], 3)
    assert found["best"] == {"epoch": 2, "val_loss": 0.3, "val_iou": 0.5, "val_near_mae": 0.1}
    code, said, _ = run(capsys, f"inspect {run_folder}")
    assert (code, "best.val_iou" in said) == (0, True)


def test_files_that_are_none_of_these_end_in_one_line(tmp_path, capsys):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = [1]
    (tmp_path / "broken.h5").write_bytes(b"no")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.csv").write_text("epoch\n")
    with h5py.File(tmp_path / "shard.h5", "w") as file:
        file["occupancy"] = file["tudf"] = np.zeros((3, 4, 4, 2), np.float32)
    for name in ("shard.h5", "other.h5", "broken.h5", "none.h5", "none.pcd", "none.xml", "run"):
        assert name in refused(capsys, f"inspect {tmp_path}/{name}")
    assert "shard of a dataset" in refused(capsys, f"inspect {tmp_path}/shard.h5")
