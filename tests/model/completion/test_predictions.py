"""Predictions on disk: what the bench takes, and single scans."""

import gc
import resource
import warnings
from functools import partial

import h5py
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from scenegen import Dataset
from scenegen.base.errors import DatasetError
from scenegen.cli.complete import complete_scans
from scenegen.model.bench.methods import Predicted
from scenegen.model.completion import predictions
from scenegen.model.completion.predictions import predict_split
from scenegen.model.completion.scans import predict_scan, read_scan, summary
from scenegen.model.config import Thresholds
from tests.conftest import contents
from tests.model.conftest import completer_of
from tests.refusals import check_wording, refuses


@pytest.fixture
def net(folders, tmp_path):
    return completer_of(tmp_path / "net.safetensors", Dataset(folders[0]).grid)


@pytest.mark.parametrize("variant", ["proposed", "tudf"])
def test_predictions_are_what_the_bench_takes(folders, tmp_path, variant, monkeypatch):
    """And a run goes on where it was, in the folders of many files, too."""
    monkeypatch.setattr(predictions, "PART", 2)
    monkeypatch.setattr(predictions, "stem_of", "{0}-0xx/{0}-{1}".format)
    dataset, out = Dataset(folders[1]), tmp_path / "p"
    net = completer_of(tmp_path / "net.safetensors", dataset.grid, variant=variant)
    counts = []
    for _ in range(2):
        predict_split(net, dataset, "test", out, on_start=counts.append, on_done=counts.append)
    assert counts == [5, 2, 2, 1, 0]
    Predicted(out).check(dataset, "test")
    split = dataset.split("test")
    for sample in split:
        stored, direct = (
            prediction.arrays()
            for prediction in (Predicted(out).completion(sample, split), net(sample.observed))
        )
        assert stored.keys() == direct.keys()
        for name, values in stored.items():
            assert_allclose(values, direct[name], atol=1e-5)


def change(place, value, name="tudf"):
    """Another value in an array."""

    def damage(path):
        with h5py.File(path, "a") as file:
            file[name][place] = value

    return damage


def swap_samples(path):
    """All columns alike, so that each row is whole, under another number."""
    with h5py.File(path, "a") as file:
        for name in file:
            file[name][:] = file[name][:][::-1]


DAMAGES = {
    "flip": change((1, 3, 4, 5), 0.123),
    "NaN": change((0, 0, 0, 0), np.nan, "occupancy_probability"),
    "samples": swap_samples,
    "cut": lambda path: path.write_bytes(path.read_bytes()[:1000]),
    "twice": lambda path: path.write_bytes(path.with_name("test-00001.h5").read_bytes()),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_predictions_are_made_again(folders, net, tmp_path, damage, monkeypatch):
    """And the bench refuses them."""
    monkeypatch.setattr(predictions, "PART", 2)
    out, dataset = tmp_path / "p", Dataset(folders[0])
    predict_split(net, dataset, "test", out)
    whole = contents(out)
    DAMAGES[damage](out / "test-00000.h5")
    refuses(damage, Predicted(out).check, dataset, "test")
    assert predict_split(net, dataset, "test", out).damaged == ["test-00000.h5"]
    assert contents(out) == whole


def scans_in(folder, **points):
    """Scans by name, each as a task of `complete_scans`; their sensor is at the origin."""
    for name, rows in points.items():
        np.save(folder / f"{name}.npy", rows)
        yield name, partial(read_scan, folder / f"{name}.npy", [0, 0, 0])


def test_damaged_completions_are_made_again(net, tmp_path, capsys):
    tasks = list(scans_in(tmp_path, a=np.full((4, 3), 0.5), b=np.full((4, 3), 1.5)))
    out, run = tmp_path / "out", partial(complete_scans, net, 2, tasks, tmp_path / "out", True)
    run()
    whole = contents(out)
    change((1, 2, 3), 0.123)(out / "a.h5")
    run()
    (out / "b.h5").write_bytes(whole["a.h5"])  # whole, and of another scan
    run()
    assert capsys.readouterr().err.count("completed again") == 2
    assert contents(out) == whole


def test_scans_are_completed_as_their_samples(folders, net, tmp_path):
    """Points beyond the map, and those without a return, are counted."""
    dataset, out = Dataset(folders[0]), tmp_path / "out.h5"
    sample = dataset.split("train")[0]
    points = dataset.grid.centres(sample.origin)[sample.observed]
    far, lost = [[99e3, 0, 0], [-50, 0, 0]], [sample.position, [np.nan, 0, 0], [0, np.inf, 0]]
    np.save(tmp_path / "scan.npy", np.vstack([points, far, lost]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scan = read_scan(tmp_path / "scan.npy", sample.position)
        report = predict_scan(net, scan, out)
    counts = report.inside, report.points, report.without
    assert counts == (len(points), len(points) + 5, 3)
    check_wording("summary", "; ".join(summary(net, [report])))
    expected = net(sample.observed)
    with h5py.File(out) as file:
        assert np.array_equal(file["observed"][:], sample.observed)
        assert_allclose(file["tudf"][:], expected.tudf, atol=1e-5)
        assert_allclose(file.attrs["origin"], sample.origin)
    thresholds = Thresholds(probability=float(np.quantile(expected.occupancy_probability, 0.9)))
    predict_scan(net, scan, tmp_path / "out.ply", thresholds=thresholds)
    cloud = np.asarray(trimesh.load(tmp_path / "out.ply").vertices)
    voxels = np.unique(dataset.grid.index(cloud, sample.origin), axis=0)
    assert np.array_equal(voxels, np.argwhere(expected.occupied(thresholds)))


def test_unfit_scans_and_places_are_refused(net, tmp_path):
    tasks = dict(scans_in(tmp_path, far=np.full((4, 3), 1000.0), good=np.full((4, 3), 0.5)))
    refuses("far", predict_scan, net, tasks["far"](), tmp_path / "o.h5")
    refuses("format", predict_scan, net, tasks["good"](), tmp_path / "o.txt")
    assert not list(tmp_path.glob("o.*"))
    for name in ("scan.e57", "missing.npy"):
        refuses(name, read_scan, tmp_path / name, [0, 0, 0])
    refuses("sensor", read_scan, tmp_path / "good.npy", [0, 0, np.nan])


@pytest.mark.parametrize("room", [1, 3000])
def test_a_full_disk_leaves_nothing(room, folders, net, tmp_path, capfd):
    """As a limit of files' sizes has it; HDF5 itself says more, and goes on saying it."""
    tasks = list(scans_in(tmp_path, s=np.full((4, 3), 0.5), t=np.full((4, 3), 0.5)))
    before, limits = set(tmp_path.iterdir()), resource.getrlimit(resource.RLIMIT_FSIZE)
    split = predict_split, net, Dataset(folders[0]), "train", tmp_path / "p"
    lines = []
    for act, *given in (split, (complete_scans, net, 2, tasks, tmp_path, True)):
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, limits[1]))
        try:
            with pytest.raises(DatasetError) as caught:
                act(*given)
            lines.append(str(caught.value))
            gc.collect()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    for number, line in enumerate(lines):  # which a file of any size may hold now
        check_wording((room, number), line)
    assert {path.name for path in {*tmp_path.rglob("*")} - before} <= {"p", "predictions.json"}
    assert capfd.readouterr() == ("", "")
