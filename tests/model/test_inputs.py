"""What a network is shown: trained on, completed from and exported by name; a new channel takes one
entry."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from lidarsim import GridSpec
from scenegen import Completer, Dataset
from scenegen.model.bench.methods import Predicted
from scenegen.model.checkpoint import load_network, load_tensors, save_network, save_tensors
from scenegen.model.completion.predictions import predict_split
from scenegen.model.inputs import PointScan, channels
from scenegen.truth import distance_field
from tests.model.conftest import saved_network
from tests.model.training.runs import maps_of
from tests.refusals import refuses

GRID = GridSpec(shape=(16, 24, 8))
BOTH = ("observed", "free")


def test_free_space_is_given_to_networks(folders, tmp_path):
    """Of a split, a row of the bench, a sample, a map and points."""
    dataset, path = Dataset(folders[1]), tmp_path / "net.safetensors"
    split, grid = dataset.split("test"), dataset.grid
    network = saved_network(path, grid, inputs=BOTH)
    with torch.no_grad():
        network.preprocess[0].weight.mul_(1e3)  # so that inputs count
    save_network(path, network, grid, {})
    completer, sample = Completer.from_pretrained(path), split[0]
    maps = {name: torch.from_numpy(getattr(sample, name)[None]) for name in BOTH}
    with torch.no_grad():
        expected, blind = (
            network(maps | more).logits.sigmoid()[0].numpy()
            for more in ({}, {"free": torch.zeros(1, *grid.shape)})
        )
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
    assert rays["free"].any()
    assert not (rays["free"] & ~sample.free).any()
    assert_allclose(completer(points, sensor=position).tudf, completer(rays).tudf)
    refuses("by name", completer, {"observed": sample.observed})
    refuses("far", completer, 1e3 * points, sensor=position)
    refuses("flat", completer, points[:, :2], sensor=position)


def test_distances_are_those_from_observed_voxels(folders):
    dataset = Dataset(folders[0])
    sample, grid = dataset.split("test")[1], dataset.grid
    scan = PointScan(points=sample.points(), position=sample.position, grid=grid)
    for seen in (sample, scan):
        (distance,) = channels(("distance",), seen, grid, dataset.lidar).values()
        assert np.array_equal(distance, distance_field(sample.observed, grid))


def test_channels_turn_with_their_map(folders):
    maps = maps_of(folders, ("observed", "distance"))
    plain, quarter = maps[3], maps[3, 1]
    for name in ("observed", "occupancy", "distance"):
        assert torch.equal(quarter[name], torch.rot90(plain[name], 1, (0, 1)))


@pytest.mark.parametrize("inputs", [(), ("observed", "observed"), ("smell",), ([1],)], ids=str)
def test_unknown_inputs_are_refused(inputs, tmp_path):
    path = tmp_path / "net.safetensors"
    saved_network(path, GRID)
    tensors, header = load_tensors(path)
    save_tensors(path, tensors, header | {"network": {"width": 4, "inputs": inputs}})
    refuses(inputs, load_network, path)
    save_tensors(path, tensors, header | {"network": {"width": 4}})  # of earlier commits
    assert load_network(path)[0].config.inputs == ("observed",)
