"""Predictions on disk: what the bench takes, and single scans."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import trimesh

from model.bench.predicted import Predicted
from model.checkpoint import save_network
from model.complete import Thresholds
from model.completer import Completer
from model.network import Network, NetworkConfig
from model.predict import predict_scan, predict_split
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError
from tests.model.conftest import make_dataset


def completer(tmp_path: Path, grid: object, variant: str = "proposed") -> Completer:
    torch.manual_seed(0)
    save_network(tmp_path / "net.safetensors", Network(NetworkConfig(variant=variant, width=4)), grid, {})
    return Completer.from_pretrained(tmp_path / "net.safetensors")


@pytest.mark.parametrize("variant", ["proposed", "tudf"])
def test_a_predictions_file_is_what_the_bench_takes(folders: list[Path], tmp_path: Path, variant: str) -> None:
    dataset = Dataset(folders[1])
    net = completer(tmp_path, dataset.grid, variant)
    told = []
    predict_split(net, folders[1], "test", tmp_path / "p.h5", batch=2, on_start=told.append, on_done=told.append)
    assert told == [5, 2, 2, 1]
    method = Predicted(tmp_path / "p.h5")
    method.check(dataset, "test")
    for sample in dataset.split("test"):
        read, direct = method.completion(sample, split="test", grid=dataset.grid), net(sample.observed)
        np.testing.assert_allclose(read.tudf, direct.tudf, atol=1e-5)
        if variant == "tudf":
            assert read.occupancy_probability is None
        else:
            np.testing.assert_allclose(read.occupancy_probability, direct.occupancy_probability, atol=1e-5)


def test_a_failure_leaves_no_file(folders: list[Path], tmp_path: Path) -> None:
    dataset = Dataset(folders[0])
    net = completer(tmp_path, dataset.grid)

    def fail(samples: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        predict_split(net, folders[0], "test", tmp_path / "p.h5", on_done=fail)
    assert [path.name for path in tmp_path.iterdir()] == ["net.safetensors"]


def test_maps_of_another_grid_are_refused(folders: list[Path], tmp_path: Path) -> None:
    other = make_dataset(tmp_path / "other", grid={"shape": (16, 16, 16)})
    net = completer(tmp_path, Dataset(folders[0]).grid)
    with pytest.raises(DatasetError, match="train a network on this grid"):
        predict_split(net, other, "test", tmp_path / "p.h5")


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".xyz"])
def test_a_scan_of_a_sample_is_completed_as_the_sample_is(folders: list[Path], tmp_path: Path, suffix: str) -> None:
    dataset = Dataset(folders[0])
    sample = dataset.split("train")[0]
    net = completer(tmp_path, dataset.grid)
    points = dataset.grid.centres(sample.origin)[sample.observed]
    path = tmp_path / f"scan{suffix}"
    if suffix == ".ply":
        trimesh.PointCloud(points).export(path)
    elif suffix == ".npy":
        np.save(path, np.vstack([points, np.full((1, 3), np.nan)]))  # a ray without return
    else:
        np.savetxt(path, points)
    out = tmp_path / "out.h5"
    predict_scan(net, path, out, sensor=sample.position, thresholds=Thresholds())
    expected = net(sample.observed)
    with h5py.File(out) as file:
        assert np.array_equal(file["observed"][:], sample.observed)
        np.testing.assert_allclose(file["tudf"][:], expected.tudf, atol=1e-5)
        np.testing.assert_allclose(file.attrs["origin"], sample.origin)
    thresholds = Thresholds(probability=float(np.quantile(expected.occupancy_probability, 0.9)))
    predict_scan(net, path, tmp_path / "out.ply", sensor=sample.position, thresholds=thresholds)
    cloud = np.asarray(trimesh.load(tmp_path / "out.ply").vertices)
    assert np.array_equal(
        np.unique(dataset.grid.index(cloud, sample.origin), axis=0), np.argwhere(expected.occupied(thresholds))
    )


def test_files_that_are_no_scans_are_refused(folders: list[Path], tmp_path: Path) -> None:
    net = completer(tmp_path, Dataset(folders[0]).grid)
    np.save(tmp_path / "flat.npy", np.zeros(7))
    np.save(tmp_path / "pickled.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.save(tmp_path / "far.npy", np.full((4, 3), 1000.0))
    np.save(tmp_path / "good.npy", np.zeros((4, 3)))
    (tmp_path / "broken.ply").write_text("ply\nnonsense")
    (tmp_path / "scan.las").write_text("")
    for name, out, said in (
        ("flat.npy", "o.h5", "expected \\(N, 3\\)"),
        ("pickled.npy", "o.h5", "cannot be read"),
        ("far.npy", "o.h5", "give --sensor"),
        ("broken.ply", "o.h5", "cannot be read"),
        ("scan.las", "o.h5", "expected one of"),
        ("missing.npy", "o.h5", "no such file"),
        ("good.npy", "o.txt", "ends in .h5 or .ply"),
    ):
        with pytest.raises(DatasetError, match=said) as caught:
            predict_scan(net, tmp_path / name, tmp_path / out, thresholds=Thresholds())
        assert "\n" not in str(caught.value)
        assert not (tmp_path / out).exists()
