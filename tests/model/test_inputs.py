"""What a network is shown: trained on, completed from and exported by name; a new channel takes one
entry."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from lidarsim import GridSpec
from scenegen.dataset.read import Dataset
from scenegen.model.bench.methods import Predicted
from scenegen.model.bench.metrics import METRICS
from scenegen.model.checkpoint import (
    CheckpointError,
    load_network,
    load_tensors,
    save_tensors,
)
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.predictions import predict_split
from scenegen.model.completion.scans import predict_scan, read_scan
from scenegen.model.config import INPUTS, NetworkConfig
from scenegen.model.inputs import PointScan, channels
from tests.model.bench.test_metrics import ALARMS
from tests.model.conftest import completer_of, saved_network
from tests.model.training.runs import SMALL, maps_of, train

GRID = GridSpec(shape=(16, 24, 8))
BOTH = ("observed", "free")


@pytest.mark.usefixtures("undrawn")
def test_free_space_and_a_new_metric_go_all_the_way(folders, tmp_path, monkeypatch):
    """Two steps of training, validation, card, then a split, a row of the bench and a scan."""
    monkeypatch.setitem(METRICS, "alarms", ALARMS)
    config = replace(SMALL, network=NetworkConfig(width=4, inputs=BOTH), epochs=1, batch=12)
    (row,) = train(folders, config, tmp_path / "run")
    assert 0 <= row["val_alarms"] <= 1
    assert "| alarms |" in (tmp_path / "run" / "card.md").read_text()

    network, grid, _ = load_network(tmp_path / "run" / "best.safetensors")
    assert network.config.inputs == BOTH
    completer = Completer.from_pretrained(tmp_path / "run")
    dataset = Dataset(folders[1])
    split = dataset.split("test")
    sample = split[0]
    maps = {name: torch.from_numpy(getattr(sample, name)[None]) for name in BOTH}
    with torch.no_grad():
        expected = network(maps).logits.sigmoid()[0].numpy()
        blind = network({**maps, "free": torch.zeros(1, *grid.shape)}).logits.sigmoid()[0].numpy()
    assert not np.allclose(expected, blind, atol=1e-4)  # the second channel counts

    predict_split(completer, dataset, "test", tmp_path / "p")
    alone = Completer.from_pretrained(tmp_path / "run", threads=1)
    for found in (
        Predicted(tmp_path / "p").completion(sample, split),
        alone.completion(sample, split),
        completer.complete(sample.observed, sample.free, grid=grid),
        completer(sample),
    ):
        assert_allclose(found.occupancy_probability, expected, atol=1e-5)
    with pytest.raises(ValueError, match="run takes observed, free; free is not given"):
        completer({"observed": sample.observed})
    rays = channels(BOTH, completer.scan_of(sample.points(), sample.position), grid)
    assert np.array_equal(rays["observed"], sample.observed)
    assert rays["free"].sum() < sample.free.sum()
    lost = np.vstack([sample.points(), np.full((2, 3), np.nan)])
    assert_allclose(completer(lost, sensor=sample.position).tudf, completer(rays).tudf)
    for points, said in (
        (1e3 * lost, "none of .* points is in the map"),
        (lost[:, :2], r"expected \(N, 3\), metres"),
        (sample.observed, "free is not given: .* or points"),
    ):
        with pytest.raises(ValueError, match=said):
            completer(points, sensor=sample.position)

    np.save(tmp_path / "scan.npy", grid.centres(sample.origin)[sample.observed])
    predict_scan(completer, read_scan(tmp_path / "scan.npy", sample.position), tmp_path / "s.h5")
    with h5py.File(tmp_path / "s.h5") as file:
        assert np.array_equal(file["observed"], sample.observed)
        held = {name: file[name][:] for name in (*BOTH, "tudf")}
    assert held["free"].any()
    assert_allclose(completer(held).tudf, held["tudf"], atol=1e-5)


def test_free_space_of_points_is_what_lies_on_the_way_to_them(folders, rng):
    """Against steps of a hundredth of a voxel, which pass over corners alone; and of rays without a
    return it knows nothing."""
    sample = Dataset(folders[0]).split("test")[0]
    centre = sample.position
    points = centre + rng.normal(size=(50, 3)) * [2.0, 3.0, 0.7]
    scan = PointScan(points=np.vstack([points, centre]), position=centre, grid=GRID)
    found = channels(BOTH, scan, GRID)
    stepped = np.zeros(GRID.shape, bool)
    for share in np.linspace(0.0, 1.0, 8000):
        index = GRID.index(centre + share * (points - centre), scan.origin)
        stepped[tuple(index[((index >= 0) & (index < GRID.shape)).all(axis=1)].T)] = True
    stepped &= ~found["observed"]
    assert not (stepped & ~found["free"]).any()
    assert (found["free"] & ~stepped).sum() < 0.02 * stepped.sum()
    assert not (found["free"] & found["observed"]).any()


def test_inputs_of_a_sample_by_their_definitions(folders, rng):
    """`distance` against every pair of voxels."""
    dataset = Dataset(folders[0])
    sample, grid = dataset.split("test")[1], dataset.grid
    found = channels(tuple(INPUTS.builtin), sample, grid, dataset.lidar)
    scan = PointScan(points=sample.points(), position=sample.position, grid=grid)
    points = channels(tuple(INPUTS.builtin), scan, grid)
    assert np.array_equal(points["distance"], found["distance"])
    voxels = np.argwhere(sample.observed)
    for at in rng.integers(0, grid.shape, (40, 3)):
        nearest = grid.voxel_m * np.sqrt(((voxels - at) ** 2).sum(axis=1).min())
        assert found["distance"][tuple(at)] == pytest.approx(min(nearest, grid.truncation_m))


def test_channels_turn_with_their_map(folders):
    maps = maps_of(folders, ("observed", "distance"))
    plain, quarter = maps[3], maps[3, 1]
    for name in ("observed", "occupancy", "distance"):
        assert torch.equal(quarter[name], torch.rot90(plain[name], 1, (0, 1)))


@pytest.mark.parametrize("inputs", [(), ("observed", "observed"), ("smell",), ([1],)], ids=str)
def test_inputs_that_nobody_knows_are_refused(inputs, tmp_path):
    with pytest.raises((ValueError, TypeError)):
        NetworkConfig(inputs=inputs)
    path = tmp_path / "net.safetensors"
    saved_network(path, GRID)
    tensors, header = load_tensors(path)
    save_tensors(path, tensors, header | {"network": {"width": 4, "inputs": inputs}})
    with pytest.raises(CheckpointError, match="do not fit"):
        load_network(path)
    del header["network"]["inputs"]  # as networks of earlier commits lack it
    save_tensors(path, tensors, header)
    assert load_network(path)[0].config.inputs == ("observed",)


def test_maps_that_an_input_cannot_be_are_refused(tmp_path):
    inputs = ("observed", "distance")
    completer = completer_of(tmp_path / "net.safetensors", GRID, inputs=inputs)
    seen, metres = np.zeros(GRID.shape, bool), np.full(GRID.shape, 0.5, np.float32)
    assert completer({"observed": seen, "distance": metres}).tudf.shape == GRID.shape
    for wrong, said in (
        (np.full(GRID.shape, np.nan), "distance holds NaN or infinity"),
        (np.zeros((2, *GRID.shape)), "have shapes"),
        (np.zeros((4, 4, 4)), "distance has shape"),
    ):
        with pytest.raises(ValueError, match=said):
            completer({"observed": seen, "distance": wrong})
