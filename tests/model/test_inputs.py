"""What a network is shown: trained on, completed from and exported by name; a new channel takes one
entry."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from lidarsim import GridSpec
from scenegen.dataset.read import Dataset
from scenegen.model.bench.methods import Predicted
from scenegen.model.checkpoint import (
    load_network,
    load_tensors,
    save_network,
    save_tensors,
)
from scenegen.model.completion.completer import Completer
from scenegen.model.completion.predictions import predict_split
from scenegen.model.config import NetworkConfig
from scenegen.model.inputs import PointScan, channels
from tests.model.conftest import saved_network
from tests.model.training.runs import maps_of
from tests.refusals import refuses

GRID = GridSpec(shape=(16, 24, 8))
BOTH = ("observed", "free")


def test_free_space_is_given_to_networks(folders, tmp_path):
    """Of a split, a row of the bench, a sample, a map and points."""
    dataset = Dataset(folders[1])
    split, grid = dataset.split("test"), dataset.grid
    network = saved_network(tmp_path / "net.safetensors", grid, inputs=BOTH)
    with torch.no_grad():
        network.preprocess[0].weight.mul_(1e3)  # so that inputs count
    save_network(tmp_path / "net.safetensors", network, grid, {})
    completer = Completer.from_pretrained(tmp_path / "net.safetensors")
    sample = split[0]
    maps = {name: torch.from_numpy(getattr(sample, name)[None]) for name in BOTH}
    with torch.no_grad():
        expected = network(maps).logits.sigmoid()[0].numpy()
        blind = network(maps | {"free": torch.zeros(1, *grid.shape)}).logits.sigmoid()[0].numpy()
    assert not np.allclose(expected, blind, atol=1e-4)  # the second channel counts

    predict_split(completer, dataset, "test", tmp_path / "p")
    for prediction in (
        Predicted(tmp_path / "p").completion(sample, split),
        completer.completion(sample, split),
        completer.complete(sample.observed, sample.free, grid=grid),
        completer(sample),
    ):
        assert_allclose(prediction.occupancy_probability, expected, atol=1e-5)
    points, position = np.vstack([sample.points(), np.full((2, 3), np.nan)]), sample.position
    rays = channels(BOTH, completer.scan_of(points, position), grid)
    assert np.array_equal(rays["observed"], sample.observed)
    assert_allclose(completer(points, sensor=position).tudf, completer(rays).tudf)
    refuses("by name", completer, {"observed": sample.observed})
    refuses("observed", completer, sample.observed)
    refuses("far", completer, 1e3 * points, sensor=position)
    refuses("flat", completer, points[:, :2], sensor=position)


def test_free_space_of_points_is_what_lies_on_the_way_to_them(folders, rng):
    """Against steps of a hundredth of a voxel, which pass over corners alone; and of rays without a
    return it knows nothing."""
    sample = Dataset(folders[0]).split("test")[0]
    centre = sample.position
    points = centre + rng.normal(size=(50, 3)) * [2.0, 3.0, 0.7]
    scan = PointScan(points=np.vstack([points, centre]), position=centre, grid=GRID)
    seen = channels(BOTH, scan, GRID)
    stepped = np.zeros(GRID.shape, bool)
    for share in np.linspace(0.0, 1.0, 8000):
        index = GRID.index(centre + share * (points - centre), scan.origin)
        stepped[tuple(index[((index >= 0) & (index < GRID.shape)).all(axis=1)].T)] = True
    stepped &= ~seen["observed"]
    assert not (stepped & ~seen["free"]).any()
    assert (seen["free"] & ~stepped).sum() < 0.02 * stepped.sum()
    assert not (seen["free"] & seen["observed"]).any()


def test_distances_are_those_of_all_voxels(folders, rng):
    dataset = Dataset(folders[0])
    sample, grid = dataset.split("test")[1], dataset.grid
    (distance,) = channels(("distance",), sample, grid, dataset.lidar).values()
    scan = PointScan(points=sample.points(), position=sample.position, grid=grid)
    assert np.array_equal(channels(("distance",), scan, grid)["distance"], distance)
    voxels = np.argwhere(sample.observed)
    for at in rng.integers(0, grid.shape, (40, 3)):
        nearest = grid.voxel_m * np.sqrt(((voxels - at) ** 2).sum(axis=1).min())
        assert distance[tuple(at)] == pytest.approx(min(nearest, grid.truncation_m))


def test_channels_turn_with_their_map(folders):
    maps = maps_of(folders, ("observed", "distance"))
    plain, quarter = maps[3], maps[3, 1]
    for name in ("observed", "occupancy", "distance"):
        assert torch.equal(quarter[name], torch.rot90(plain[name], 1, (0, 1)))


@pytest.mark.parametrize("inputs", [(), ("observed", "observed"), ("smell",), ([1],)], ids=str)
def test_unknown_inputs_are_refused(inputs, tmp_path):
    with pytest.raises((ValueError, TypeError)):
        NetworkConfig(inputs=inputs)
    path = tmp_path / "net.safetensors"
    saved_network(path, GRID)
    tensors, header = load_tensors(path)
    save_tensors(path, tensors, header | {"network": {"width": 4, "inputs": inputs}})
    refuses(inputs, load_network, path)
    save_tensors(path, tensors, header | {"network": {"width": 4}})  # of earlier commits
    assert load_network(path)[0].config.inputs == ("observed",)
