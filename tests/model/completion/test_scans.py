"""Completions of logs: their scans stand upright, and observations are scored."""

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lidarsim import GridSpec, Pose
from lidarsim.pose import rotate
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.scans import height_above_returns, predict_scan, read_scan
from scenegen.worlds.clouds.write import write_points
from scenegen.worlds.place import FREE
from tests.command_line import refused, run
from tests.conftest import hall_in

TILT = Pose(
    position=np.array([3.0, -2.0, 1.2]),
    quaternion=np.array([np.cos(0.3), 0.0, np.sin(0.3), 0.0]),
)


@pytest.fixture(scope="module")
def points():
    """Returns (N, 3) from a floor 1.27 m below the sensor, and from a wall."""
    x, y = np.meshgrid(np.linspace(-6, 6, 40), np.linspace(-6, 6, 40))
    floor = np.stack([x, y, np.full_like(x, -1.27)], axis=-1).reshape(-1, 3)
    wall = np.stack([np.full_like(x, 5.05), y, x / 6], axis=-1).reshape(-1, 3)
    return np.concatenate([floor, wall])


def test_scans_of_a_log_stand_upright_in_its_frame(tmp_path, points, capsys):
    log = tmp_path / "log"
    inverse = TILT.quaternion * [1, -1, -1, -1]
    for n in range(3):
        write_points(log / "velodyne" / f"{n:06d}.bin", rotate(inverse, points), None, {})
    matrix = np.column_stack([rotate(TILT.quaternion, np.eye(3)).T, TILT.position])
    np.savetxt(log / "poses.txt", np.stack([matrix.ravel()] * 3))
    words = ("complete", log, "--every", 2, "-o", tmp_path / "out", "--device", "cpu")
    assert "calib.txt: no such file" in refused(capsys, *words)
    assert "leave out --topic" in refused(capsys, "complete", log / "velodyne", "--topic", "/a")
    code, said, noted = run(capsys, *words, "--poses-of", "sensor")
    assert (
        "read: 3 clouds, x y z intensity (KITTI .bin, 4 columns), frame of the sensor, poses of"
        in noted
    )
    assert (code, said.startswith(f"{tmp_path / 'out'}: 2 completions")) == (0, True)
    assert "the sensor is some 1.3 m above what it sees" in noted
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *("000000.h5", "000002.h5", "completions.json", "index.html")
    ]
    np.save(tmp_path / "level.npy", points + TILT.position)
    level = read_scan(tmp_path / "level.npy", TILT.position)
    predict_scan(Completer.from_pretrained("anywhere"), level, tmp_path / "level.h5")
    with h5py.File(tmp_path / "out" / "000002.h5") as file, h5py.File(tmp_path / "level.h5") as own:
        assert_allclose(file.attrs["origin"], own.attrs["origin"], atol=1e-6)
        alike = np.asarray(file["observed"]) == np.asarray(own["observed"])
    assert alike.mean() > 0.999  # but where float32 moves a point over a voxel's face


@pytest.mark.parametrize("arm", [0.0, 1.2])
@pytest.mark.parametrize("moved", [False, True])
def test_rays_without_a_return_change_no_completion(tmp_path, points, arm, moved, capsys):
    """Ouster's 0 0 0: left as they are where points are moved to the sensor's height, or moved."""
    lost = np.arange(len(points)) % 3 == 0
    shift = np.array([0.0, 0.0, arm])
    rows = np.where(lost[:, None], 0.0, points) + shift
    if not moved:
        rows[lost] = 0.0
    np.save(tmp_path / "zeros.npy", rows)
    np.save(tmp_path / "clean.npy", points[~lost] + shift)
    notes = []
    for name in ("zeros", "clean"):
        words = "complete", tmp_path / f"{name}.npy", "--sensor", 0, 0, arm, "--device", "cpu"
        code, said, noted = run(capsys, *words, "-o", tmp_path / f"{name}.h5")
        assert code == 0
        notes.append(noted)
        assert f"{(~lost).sum()} of" in said
    with h5py.File(tmp_path / "zeros.h5") as zeros, h5py.File(tmp_path / "clean.h5") as clean:
        for name in ("observed", "free", "occupancy_probability", "tudf"):
            assert_array_equal(zeros[name][:], clean[name][:])
    shape = "3 columns"
    assert notes[0] == (
        f"read: {len(points):,} points, x y z (.npy, {shape}); {lost.sum():,} without a return "
        "dropped\n"
    )
    assert "dropped" not in notes[1]


def test_scans_without_a_true_return_are_refused(tmp_path, points, capsys):
    np.save(tmp_path / "far.npy", np.concatenate([points, [[0, 2e5, 0]]]))
    said = refused(capsys, "complete", tmp_path / "far.npy", "--device", "cpu")
    assert f"1 of {len(points) + 1} points lie up to 2e+05 m from the sensor" in said
    np.save(tmp_path / "zeros.npy", np.zeros((9, 3)))
    said = refused(capsys, "complete", tmp_path / "zeros.npy", "--device", "cpu")
    assert "none of 9 points is in the map (9 are no returns)" in said


def test_an_observation_is_scored_over_what_its_log_knows(tmp_path, points, rng):
    grid = GridSpec()
    truth = {name: rng.random(grid.shape) < 0.5 for name in ("occupancy", "known")}
    np.savez(tmp_path / "seen.npz", points=points, voxel_m=grid.voxel_m, **truth)
    np.savez(tmp_path / "other.npz", points=points, voxel_m=0.1, **truth)
    completer = Completer.from_pretrained("anywhere")
    done = predict_scan(completer, read_scan(tmp_path / "seen.npz", [0, 0, 0]), tmp_path / "s.h5")
    with h5py.File(tmp_path / "s.h5") as file:
        said = file["occupancy_probability"][()][truth["known"]] > 0.85
    true = truth["occupancy"][truth["known"]]
    assert done.iou == pytest.approx((said & true).sum() / (said | true).sum())
    other = read_scan(tmp_path / "other.npz", [0, 0, 0])
    assert predict_scan(completer, other, tmp_path / "o.h5").iou is None


def test_the_ground_is_what_lies_below_the_sensor(points):
    assert height_above_returns(points) == pytest.approx(1.27)
    assert height_above_returns(points[points[:, 2] > 0]) is None


def test_a_map_is_refused_with_what_to_do(tmp_path, capsys):
    words = ("complete", hall_in(tmp_path, np.full((20, 20, 20), FREE, np.uint8)))
    assert "scenegen generate --scene" in refused(capsys, *words)
