"""What torch is given is what the shards hold, whoever reads it."""

import gc
import multiprocessing
import shutil
from functools import partial

import h5py
import numpy as np
import pytest
import torch

from lidarsim import Lidar
from scenegen.base.errors import DatasetError, ScenegenError
from scenegen.dataset.read import Dataset
from scenegen.dataset.selection import Choice, choose, encode_selection
from scenegen.model.api import train
from scenegen.model.completion.completer import unlike
from scenegen.model.config import TrainConfig
from scenegen.model.inputs import SYMMETRIES
from scenegen.model.training.data import (
    Maps,
    epoch_batches,
    load,
    opened,
    views,
)
from scenegen.model.training.loop import origin
from tests.model.conftest import COUNTS, make_dataset
from tests.model.training.runs import maps_of


def test_maps_are_the_samples_of_all_datasets_in_order(folders):
    maps = maps_of(folders)
    samples = [sample for folder in folders for sample in Dataset(folder).split("train")]
    assert len(maps) == len(samples) == 2 * COUNTS["train"]
    for number, sample in enumerate(samples):
        observed, occupancy = maps[number]["observed"], maps[number]["occupancy"]
        assert observed.dtype == occupancy.dtype == torch.bool
        assert np.array_equal(observed, sample.observed)
        assert np.array_equal(occupancy, sample.occupancy)
        assert np.array_equal(maps[number]["tudf"], sample.tudf)
    assert maps.name(COUNTS["train"] + 2) == f"{folders[1]}, train sample 2"
    with pytest.raises(IndexError):
        maps[len(samples)]


def test_loader_workers_read_the_same_after_their_parent_has_read(folders):
    maps = maps_of(folders)
    batches = [[5, 1, 20], [23, 0, 7], [12, 13, 3]]
    here = list(load(maps, batches, workers=0, pinned=False))
    forked = list(load(maps, batches, workers=3, pinned=False))
    for one, other in zip(here, forked, strict=True):
        assert one.keys() == other.keys() == {"observed", "occupancy", "tudf"}
        assert all(torch.equal(one[name], other[name]) for name in one)


def test_damage_is_named(folders, tmp_path):
    copy = shutil.copytree(folders[0], tmp_path / "copy")
    with h5py.File(copy / "train-00000.h5", "r+") as file:
        file["occupancy"].id.write_direct_chunk((1, 0, 0, 0), b"not a chunk")
    maps = maps_of([copy])
    maps[0]
    said = r"^\S*train-00000\.h5: sample 1: occupancy cannot be unpacked"
    with pytest.raises(DatasetError, match=said):
        maps[1]
    before = set(multiprocessing.active_children())
    for workers in (0, 1):
        gc.disable()  # what is left must not wait for the collector
        try:
            with pytest.raises(DatasetError, match=said):
                list(load(maps, [[0], [1]], workers=workers, pinned=False))
            assert set(multiprocessing.active_children()) <= before
        finally:
            gc.enable()


def test_datasets_that_do_not_go_together_are_refused(folders, tmp_path):
    other_grid = make_dataset(tmp_path / "grid", grid={"shape": (16, 16, 16)})
    refused = {other_grid: "its grid", folders[0]: "the same samples"}
    for wrong, named in refused.items():
        with pytest.raises(DatasetError, match=named):
            maps_of([folders[0], wrong])
    with pytest.raises(DatasetError, match="no dataset given"):
        Maps([], "train")


def test_sensors_and_mappings_may_differ_and_are_remembered(folders, tmp_path):
    few = make_dataset(tmp_path / "sensor", lidar={"rows": 4, "columns": 30})
    fused = make_dataset(tmp_path / "fused", mapping={"scans": 2})
    maps = maps_of([folders[0], few, fused], ("observed", "distance"))
    assert {tuple(maps[n]["distance"].shape) for n in range(len(maps))} == {maps.grid.shape}
    about = origin(maps, "", torch.device("cpu"))
    assert [one["lidar"]["rows"] for one in about["also"]] == [4, about["lidar"]["rows"]]
    for dataset in map(Dataset, (folders[0], few, fused)):
        assert unlike("net", about, *dataset.settings[0]) == ""
    assert "another sensor" in unlike("net", about, Lidar(rows=5), *dataset.settings[0][1:])


def test_points_alone_free_less_and_hold_the_same_returns(folders, rng):
    maps = maps_of(folders[:1], ("observed", "free"))
    fewer = 0
    for n in range(len(maps)):
        whole, points = maps[n], maps[n, SYMMETRIES]
        assert (whole["observed"] == points["observed"]).all()
        assert not (points["free"] & ~whole["free"] & ~whole["observed"]).any()
        fewer += int((whole["free"] & ~points["free"]).sum())
    assert fewer
    shown = views(maps, TrainConfig(points_share=0.5), 400, rng)
    assert 150 < (shown >= SYMMETRIES).sum() < 250


def passes(maps, count, *, seed=0):
    """The maps of each of `count` passes, in order."""
    config = TrainConfig(batch=1, seed=seed)
    return [
        [index for batch in epoch_batches(maps, config, n) for index, _ in batch]
        for n in range(count)
    ]


def test_weighted_datasets_come_in_proportion_and_every_map_before_any_comes_again(folders):
    weighted = {folders[0]: 3, folders[1]: 1}
    maps = maps_of(weighted)
    seen = passes(maps, 7)
    assert seen == passes(maps, 7) != passes(maps, 7, seed=1)
    size = COUNTS["train"]
    for number, share in enumerate((18, 6)):  # of 24 in a pass
        own = [[index for index in one if index // size == number] for one in seen]
        assert [len(one) for one in own] == [share] * 7
        # whatever the order within a pass, after every whole turn all have come as often
        counted = np.zeros(size, int)
        for one in own:
            np.add.at(counted, np.array(one) - number * size, 1)
            assert counted.max() - counted.min() <= 1
    plain = maps_of([(folder, None) for folder in folders])
    assert sorted(passes(plain, 1)[0]) == list(range(len(maps)))  # without weights, each once


@pytest.mark.parametrize("weight", [0, -1, float("nan"), "2", True, 1e-3])
def test_weights_that_are_no_proportion_are_refused(folders, weight):
    with pytest.raises(ScenegenError, match="weight") as error:
        maps_of([(folders[0], weight), folders[1]])
    assert str(folders[0]) in str(error.value)


def test_a_dataset_and_a_selection_of_it_are_not_read_together(folders, tmp_path):
    few, choice, dataset = tmp_path / "few.json", Choice(most=2), Dataset(folders[0])
    few.write_bytes(encode_selection(dataset, choose(dataset, choice), choice, tmp_path))
    for read in (partial(opened, split="train"), train):
        with pytest.raises(DatasetError, match="holds the same samples as"):
            read([folders[0], few])
