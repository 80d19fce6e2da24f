"""Predictions on disk: what the bench takes, and single scans."""

import gc
import resource
import warnings

import h5py
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from lidarsim import GridSpec
from scenegen.base.errors import DatasetError
from scenegen.cli.complete import complete_scans
from scenegen.dataset.read import Dataset
from scenegen.model.bench.methods import Predicted
from scenegen.model.completion.predictions import predict_split
from scenegen.model.completion.scans import predict_scan, read_scan, summary
from scenegen.model.config import Thresholds
from tests.model.conftest import completer_of


@pytest.fixture
def net(folders, tmp_path):
    return completer_of(tmp_path / "net.safetensors", Dataset(folders[0]).grid)


@pytest.mark.parametrize("variant", ["proposed", "tudf"])
def test_predictions_are_what_the_bench_takes(folders, tmp_path, variant, monkeypatch):
    """And a run goes on where it was, in the folders of many files, too."""
    monkeypatch.setattr("scenegen.model.completion.predictions.PART", 2)
    monkeypatch.setattr("scenegen.model.completion.predictions.stem_of", "{0}-0xx/{0}-{1}".format)
    dataset = Dataset(folders[1])
    net = completer_of(tmp_path / "net.safetensors", dataset.grid, variant=variant)
    counts = []
    for _ in range(2):
        predict_split(
            net,
            dataset,
            "test",
            tmp_path / "p",
            on_start=counts.append,
            on_done=counts.append,
        )
    assert counts == [5, 2, 2, 1, 0]
    method = Predicted(tmp_path / "p")
    method.check(dataset, "test")
    for sample in dataset.split("test"):
        read, direct = method.completion(sample, dataset.split("test")), net(sample.observed)
        assert_allclose(read.tudf, direct.tudf, atol=1e-5)
        if variant == "tudf":
            assert read.occupancy_probability is None
        else:
            assert_allclose(read.occupancy_probability, direct.occupancy_probability, atol=1e-5)


def flip(path):
    with h5py.File(path, "a") as file:
        file["tudf"][1, 3, 4, 5] += 1e-3


def swap_rows(path):
    with h5py.File(path, "a") as file:
        file["tudf"][:] = file["tudf"][:][::-1]


def swap_samples(path):
    """All columns alike, so that each row is whole, under another number."""
    with h5py.File(path, "a") as file:
        for name in file:
            file[name][:] = file[name][:][::-1]


def put_nan(path):
    with h5py.File(path, "a") as file:
        file["occupancy_probability"][0, 0, 0, 0] = np.nan


DAMAGES = (
    flip,
    swap_rows,
    swap_samples,
    put_nan,
    lambda path: path.write_bytes(path.read_bytes()[:1000]),
    lambda path: path.write_bytes(b""),
    lambda path: path.write_bytes(path.with_name("test-00001.h5").read_bytes()),
)


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_predictions_are_made_again_and_refused_by_the_bench(
    folders, net, tmp_path, damage, monkeypatch
):
    monkeypatch.setattr("scenegen.model.completion.predictions.PART", 2)
    out = tmp_path / "p"
    predict_split(net, Dataset(folders[0]), "test", out)
    whole = {path.name: path.read_bytes() for path in out.iterdir()}
    damage(out / "test-00000.h5")
    with pytest.raises(DatasetError, match=r"p\S*: "):
        Predicted(out).check(Dataset(folders[0]), "test")
    assert predict_split(net, Dataset(folders[0]), "test", out).damaged == ["test-00000.h5"]
    assert {path.name: path.read_bytes() for path in out.iterdir()} == whole


def test_damaged_completions_of_scans_are_made_again(net, tmp_path, capsys):
    given = {}
    for name, at in (("a", 0.5), ("b", 1.5)):
        np.save(tmp_path / f"{name}.npy", np.full((4, 3), at))
        given[name] = read_scan(tmp_path / f"{name}.npy", [0, 0, 0])
    out, tasks = tmp_path / "out", [(name, lambda name=name: given[name]) for name in given]
    complete_scans(net, 2, tasks, out, True)
    whole = {path.name: path.read_bytes() for path in out.glob("*.h5")}
    with h5py.File(out / "a.h5", "a") as file:
        file["tudf"][1, 2, 3] += 1e-3
    complete_scans(net, 2, tasks, out, True)
    assert capsys.readouterr().err.count("completed again") == 1
    (out / "b.h5").write_bytes(whole["a.h5"])  # whole, and of another scan
    complete_scans(net, 2, tasks, out, True)
    assert capsys.readouterr().err.count("completed again") == 1
    assert {path.name: path.read_bytes() for path in out.glob("*.h5")} == whole


def test_maps_of_another_grid_are_refused(folders, tmp_path):
    net = completer_of(tmp_path / "net.safetensors", GridSpec(shape=(16, 16, 16)))
    with pytest.raises(DatasetError, match="train a network on this grid"):
        predict_split(net, Dataset(folders[0]), "test", tmp_path / "p")


@pytest.mark.parametrize("suffix", [".ply", ".npy"])
def test_a_scan_of_a_sample_is_completed_as_the_sample_is(folders, net, tmp_path, suffix):
    dataset = Dataset(folders[0])
    sample = dataset.split("train")[0]
    points = dataset.grid.centres(sample.origin)[sample.observed]
    path, out, count = tmp_path / f"scan{suffix}", tmp_path / "out.h5", len(points)
    if suffix == ".ply":
        trimesh.PointCloud(points).export(path)
    else:
        np.save(path, np.pad(points, ((0, 1), (0, 0)), constant_values=np.nan))  # without a return
    given = read_scan(path, sample.position)
    used, lost = predict_scan(net, given, out), int(suffix == ".npy")
    assert (used.inside, used.points, used.without) == (count, count + lost, lost)
    expected = net(sample.observed)
    with h5py.File(out) as file:
        assert np.array_equal(file["observed"][:], sample.observed)
        assert_allclose(file["tudf"][:], expected.tudf, atol=1e-5)
        assert_allclose(file.attrs["origin"], sample.origin)
    thresholds = Thresholds(probability=float(np.quantile(expected.occupancy_probability, 0.9)))
    predict_scan(net, given, tmp_path / "out.ply", thresholds=thresholds)
    cloud = np.asarray(trimesh.load(tmp_path / "out.ply").vertices)
    assert np.array_equal(
        np.unique(dataset.grid.index(cloud, sample.origin), axis=0),
        np.argwhere(expected.occupied(thresholds)),
    )


def completed(net, folder, name, out):
    """What became of a scan in the folder, whose sensor is at the origin."""
    return predict_scan(net, read_scan(folder / name, np.zeros(3)), folder / out)


def test_files_that_are_no_scans_are_refused(net, tmp_path):
    np.save(tmp_path / "far.npy", np.full((4, 3), 1000.0))
    np.save(tmp_path / "good.npy", np.zeros((4, 3)))
    for name, out, said in (
        ("far.npy", "o.h5", "--sensor"),
        ("scan.e57", "o.h5", "expected one of"),
        ("missing.npy", "o.h5", "no such file"),
        ("good.npy", "o.txt", "ends in .h5 or .ply"),
    ):
        with pytest.raises(DatasetError, match=said):
            completed(net, tmp_path, name, out)
        assert not (tmp_path / out).exists()


def test_points_beyond_the_map_and_without_a_return_are_counted(net, tmp_path):
    far, no_return = [[99e3, 0, 0], [-50, 0, 0]], [[0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0]]
    np.save(tmp_path / "scan.npy", [[0.5, 0, 0], [0.1, 0, 0], *far, *no_return])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        used = completed(net, tmp_path, "scan.npy", "out.h5")
    assert (used.inside, used.points, used.without) == (2, 7, 3)
    assert used.height_m is None
    lines = summary(net, [used])
    assert lines[0] == "2 of 7 points used, 3 without a return, 2 outside the map"
    assert "too few returns" in lines[1]
    np.save(tmp_path / "scan.npy", np.full((4, 3), np.nan))
    with pytest.raises(DatasetError, match=r"none of 4 points is in the map \(4 are no returns\)"):
        completed(net, tmp_path, "scan.npy", "none.h5")
    with pytest.raises(DatasetError, match="--sensor"):
        read_scan(tmp_path / "scan.npy", [0, 0, np.nan])


def test_only_completions_are_replaced(net, tmp_path):
    np.save(tmp_path / "scan.npy", np.full((4, 3), 0.5))
    given, out = read_scan(tmp_path / "scan.npy", [0, 0, 0]), tmp_path / "out.ply"
    for _ in range(2):
        predict_scan(net, given, out)
    out.write_bytes(b"ply\nformat ascii 1.0\n")
    with pytest.raises(DatasetError, match="is there already"):
        predict_scan(net, given, out)
    assert out.read_bytes() == b"ply\nformat ascii 1.0\n"


@pytest.mark.parametrize("room", [1, 3000])
def test_a_full_disk_ends_in_one_line_and_leaves_nothing(room, folders, net, tmp_path, capfd):
    """As a limit of files' sizes has it; HDF5 itself says more, and goes on saying it."""
    np.save(tmp_path / "scan.npy", np.full((4, 3), 0.5))
    before, given = set(tmp_path.iterdir()), read_scan(tmp_path / "scan.npy", np.zeros(3))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        with pytest.raises(DatasetError, match=r"(json|h5): File too large"):
            predict_split(net, Dataset(folders[0]), "train", tmp_path / "p")
        with pytest.raises(DatasetError, match=r"s\.h5: File too large"):
            complete_scans(net, 2, [("s", lambda: given), ("t", lambda: given)], tmp_path, True)
        gc.collect()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert {path.name for path in {*tmp_path.rglob("*")} - before} <= {"p", "predictions.json"}
    assert capfd.readouterr() == ("", "")
