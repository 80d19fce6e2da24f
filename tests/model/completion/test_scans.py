"""Completions of logs: their scans stand upright, and observations are scored."""

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_equal

from lidarsim import GridSpec, Pose
from lidarsim.grid import iou
from lidarsim.pose import rotate
from scenegen import Completer
from scenegen.model.completion.scans import predict_scan, read_scan
from scenegen.worlds.clouds.write import write_points
from scenegen.worlds.place import FREE
from tests.command_line import run
from tests.conftest import contents, hall_in
from tests.refusals import refuses_command

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


def test_scans_of_a_log_stand_upright(tmp_path, points, capsys):
    log, out = tmp_path / "log", tmp_path / "out"
    inverse = TILT.quaternion * [1, -1, -1, -1]
    for n in range(3):
        write_points(log / "velodyne" / f"{n:06d}.bin", rotate(inverse, points), None, {})
    matrix = np.column_stack([rotate(TILT.quaternion, np.eye(3)).T, TILT.position])
    np.savetxt(log / "poses.txt", np.stack([matrix.ravel()] * 3))
    words = f"complete {log} --every 2 -o {out} --device cpu"
    refuses_command(capsys, words)
    refuses_command(capsys, f"complete {log}/velodyne --topic /a")
    _, said, noted = run(capsys, f"{words} --poses-of sensor")
    assert said.startswith(f"{out}: 2 completions")
    assert "the sensor is some 1.3 m above what it sees" in noted
    assert set(contents(out)) == {"000000.h5", "000002.h5", "completions.json", "index.html"}
    np.save(tmp_path / "level.npy", points + TILT.position)
    level = read_scan(tmp_path / "level.npy", TILT.position)
    predict_scan(Completer.from_pretrained("anywhere"), level, tmp_path / "level.h5")
    with h5py.File(out / "000002.h5") as file, h5py.File(tmp_path / "level.h5") as expected:
        assert_allclose(file.attrs["origin"], expected.attrs["origin"], atol=1e-6)
        alike = file["observed"][:] == expected["observed"][:]
    assert alike.mean() > 0.999  # but where float32 moves a point over a voxel's face


@pytest.mark.parametrize(("arm", "moved"), [(0.0, True), (1.2, True), (1.2, False)])
def test_rays_without_a_return_change_nothing(tmp_path, points, arm, moved, capsys):
    """Ouster's 0 0 0: left as they are where points are moved to the sensor's height, or moved."""
    lost = np.arange(len(points)) % 3 == 0
    shift = np.array([0.0, 0.0, arm])
    zeros = np.where(lost[:, None], shift * moved, points + shift)
    maps = []
    for name, values in (("zeros", zeros), ("clean", points[~lost] + shift)):
        np.save(tmp_path / f"{name}.npy", values)
        words = f"complete {tmp_path}/{name}.npy --sensor 0 0 {arm} --device cpu"
        _, said, noted = run(capsys, f"{words} -o {tmp_path}/{name}.h5")
        assert f"{(~lost).sum()} of" in said
        assert (f"; {lost.sum():,} without a return dropped\n" in noted) == (name == "zeros")
        with h5py.File(tmp_path / f"{name}.h5") as file:
            maps.append({key: value[:] for key, value in file.items()})
    assert_equal(*maps)


def test_observations_are_scored_where_known(tmp_path, points, rng):
    """In the grid of the network, over what their log knows."""
    grid, completer = GridSpec(), Completer.from_pretrained("anywhere")
    truth = {name: rng.random(grid.shape) < 0.5 for name in ("occupancy", "known")}
    reports = []
    for voxel_m in (grid.voxel_m, 0.1):
        np.savez(tmp_path / "seen.npz", points=points, voxel_m=voxel_m, **truth)
        scan = read_scan(tmp_path / "seen.npz", [0, 0, 0])
        reports.append(predict_scan(completer, scan, tmp_path / f"{voxel_m}.h5"))
    with h5py.File(tmp_path / "0.2.h5") as file:
        said = file["occupancy_probability"][:] > 0.85
    expected = iou(said[truth["known"]], truth["occupancy"][truth["known"]])
    assert [report.iou for report in reports] == [pytest.approx(expected), None]


@pytest.mark.parametrize("name", ["far.npy", "zeros.npy", "hall.npz"])
def test_scans_that_are_none_are_refused(tmp_path, points, capsys, name):
    np.save(tmp_path / "far.npy", np.concatenate([points, [[0, 2e5, 0]]]))
    np.save(tmp_path / "zeros.npy", np.zeros((9, 3)))
    hall_in(tmp_path, np.full((20, 20, 20), FREE, np.uint8))  # a map
    refuses_command(capsys, f"complete {tmp_path}/{name} --device cpu")
