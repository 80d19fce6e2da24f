"""What torch is given is what the shards hold, whoever reads it."""

import gc
import multiprocessing
import shutil

import h5py
import numpy as np
import pytest
import torch

from lidarsim import Lidar
from scenegen import Dataset, generate
from scenegen.dataset.selection import SelectionCriteria, choose, encode_selection
from scenegen.model.api import train
from scenegen.model.completion.completer import unlike
from scenegen.model.config import TrainConfig
from scenegen.model.inputs import SYMMETRIES
from scenegen.model.training.data import load_batches, views
from scenegen.model.training.loop import describe_origin
from tests.model.conftest import COUNTS, make_dataset
from tests.model.training.runs import maps_of
from tests.model.training.test_symmetry import keys_of
from tests.refusals import refuses

SIZE = COUNTS["train"]


def test_maps_are_all_samples_in_order(folders):
    maps = maps_of(folders)
    samples = [sample for folder in folders for sample in Dataset(folder).split("train")]
    assert len(maps) == len(samples) == 2 * SIZE
    for number, sample in enumerate(samples):
        for name, values in maps[number].items():
            assert np.array_equal(values, getattr(sample, name))
    assert maps[0]["observed"].dtype == maps[0]["occupancy"].dtype == torch.bool
    assert maps.name(SIZE + 2) == f"{folders[1]}, train sample 2"
    with pytest.raises(IndexError):
        maps[len(samples)]


def test_loader_workers_read_what_their_parent_does(folders):
    maps, batches = maps_of(folders), [[5, 1, 20], [23, 0, 7], [12, 13, 3]]
    here, forked = (list(load_batches(maps, batches, workers=n, pinned=False)) for n in (0, 3))
    for batch, expected in zip(forked, here, strict=True):
        assert batch.keys() == {"observed", "occupancy", "tudf"}
        torch.testing.assert_close(batch, expected, rtol=0, atol=0)


@pytest.mark.parametrize("workers", [0, 1])
def test_damage_is_named(folders, tmp_path, workers):
    copy = shutil.copytree(folders[0], tmp_path / "copy")
    with h5py.File(copy / "train-00000.h5", "r+") as file:
        file["occupancy"].id.write_direct_chunk((1, 0, 0, 0), b"not a chunk")
    batches = load_batches(maps_of([copy]), [[0], [1]], workers=workers, pinned=False)
    before = set(multiprocessing.active_children())
    gc.disable()  # what is left must not wait for the collector
    try:
        refuses(workers, list, batches)
        assert set(multiprocessing.active_children()) <= before
    finally:
        gc.enable()


def test_datasets_that_do_not_fit_are_refused(folders, tmp_path):
    few, criteria, dataset = tmp_path / "few.json", SelectionCriteria(most=2), Dataset(folders[0])
    few.write_bytes(encode_selection(dataset, choose(dataset, criteria), criteria, tmp_path))
    cases = {
        "none": [],
        "grid": [folders[0], make_dataset(tmp_path / "grid", grid={"shape": (16, 16, 16)})],
        "twice": [folders[0]] * 2,
        "selection": [folders[0], few],
        **{
            f"weight {weight}": [(folders[0], weight), folders[1]]
            for weight in (0, -1, float("nan"), "2", True, 1e-3)
        },
    }
    for name, sources in cases.items():
        refuses(name, maps_of, sources)
    refuses("train", train, cases["selection"])


def test_worlds_for_testing_alone_are_refused(tmp_path):
    held = generate("parking", test=5, out=tmp_path / "parking")
    assert len(held.split("test")) == 5
    refuses("parking", train, [held.name])


def test_sensors_and_mappings_may_differ(folders, tmp_path):
    few = make_dataset(tmp_path / "sensor", lidar={"rows": 4, "columns": 30}, mapping={"scans": 2})
    about = describe_origin(maps_of([folders[0], few]), "", torch.device("cpu"))
    for dataset in map(Dataset, (folders[0], few)):
        assert unlike("net", about, *dataset.settings[0]) == ""
    assert "another sensor" in unlike("net", about, Lidar(rows=5), *dataset.settings[0][1:])


def test_points_alone_free_less(folders, rng):
    maps = maps_of(folders[:1], ("observed", "free"))
    fewer = 0
    for n in range(len(maps)):
        whole, points = maps[n], maps[n, SYMMETRIES]
        assert (whole["observed"] == points["observed"]).all()
        assert not (points["free"] & ~whole["free"] & ~whole["observed"]).any()
        fewer += int((whole["free"] & ~points["free"]).sum())
    assert fewer
    drawn = views(maps, TrainConfig(points_share=0.5), 400, rng)
    assert 150 < (drawn >= SYMMETRIES).sum() < 250


def test_weighted_datasets_come_in_proportion(folders):
    """And every map comes before any comes again, whatever the order within a pass; which come
    twice in a pass is drawn anew."""

    def passes(seed):
        return [
            [number for number, _ in keys_of(maps, epoch, batch=1, seed=seed)] for epoch in range(7)
        ]

    maps = maps_of({folders[0]: 3, folders[1]: 1})
    actual = passes(0)
    assert actual == passes(0) != passes(1)
    for dataset, share in enumerate((18, 6)):  # of 24 in a pass
        counts, twice = np.zeros(SIZE, int), set()
        for numbers in np.array(actual):
            numbers = numbers[numbers // SIZE == dataset]
            assert len(numbers) == share
            np.add.at(counts, numbers - dataset * SIZE, 1)
            assert counts.max() - counts.min() <= 1
            twice.add(tuple(np.flatnonzero(np.bincount(numbers) == 2)))
        assert (len(twice) > 2) == (dataset == 0)
    maps = maps_of([(folder, None) for folder in folders])
    assert sorted(passes(0)[0]) == list(range(len(maps)))  # without weights, each once
