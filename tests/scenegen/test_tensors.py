"""Samples as a dataset of torch's: the same values, batched by torch's own collate."""

import pickle
import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import scenegen
from lidarsim import GridSpec, Lidar
from scenegen.dataset.layout import ShardFile
from scenegen.draw.sample import FIELDS, GROUPS, Sample, SampleSequence, Schema
from tests.command_line import example
from tests.conftest import dataset_in, small_recipe
from tests.refusals import refuses

torch = pytest.importorskip("torch")
from torch.utils.data import DataLoader  # noqa: E402

OTHER_TYPES = {"uint16": "int32"}
"""Types of tensors, where they are not those of the fields."""


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tensors") / "data"
    return dataset_in(folder, counts={"train": 9, "val": 0, "test": 0}).split("train")


def check_batches(loader, samples, names):
    """Every batch holds its samples' fields, in order, as stacked by numpy."""
    first = 0
    for batch in loader:
        assert list(batch) == list(names)
        stop = first + len(batch["world"])
        for name, values in batch.items():
            kind = np.dtype(FIELDS[name]["dtype"]).name
            assert values.dtype == getattr(torch, OTHER_TYPES.get(kind, kind)), name
            expected = [getattr(samples[n], name) for n in range(first, stop)]
            assert_array_equal(values.numpy(), expected, name)
        first = stop
    assert first == len(samples)


def test_the_default_collate_batches_all_fields(samples):
    tensors = pickle.loads(pickle.dumps(samples.torch()))
    assert isinstance(tensors, torch.utils.data.Dataset)
    check_batches(DataLoader(tensors, batch_size=4), samples, GROUPS[""])


@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_processes_give_the_same_batches(samples, start):
    processes = {"num_workers": 2, "multiprocessing_context": start}
    check_batches(DataLoader(samples.torch(), batch_size=4, **processes), samples, GROUPS[""])


def test_the_page_runs_with_processes(samples):
    names = {"samples": samples}
    exec(example("load.md", "samples.torch()"), names)
    assert len(names["batch"]["observed"]) == 8


def test_only_the_fields_named_are_read(samples, monkeypatch):
    monkeypatch.setattr(
        ShardFile, "value", lambda shard, name, row, **options: np.array(name == "tudf")
    )
    assert samples.torch("tudf")[0] == {"tudf": torch.tensor(True)}


def test_a_batch_can_be_written_to(samples):
    """And neither the samples nor what comes later changes."""
    stream = scenegen.stream(small_recipe(), samples=3)
    for each in (samples, stream):
        before, batch = each[0].ranges.copy(), each.torch()[0]
        for values in batch.values():
            values.zero_()
        assert_array_equal(each.torch()[0]["ranges"], before)


class Kept(SampleSequence):
    """Samples in memory."""

    def __init__(self, samples, schema):
        self.samples, self.kind = samples, schema

    schema = property(lambda self: self.kind)

    def __len__(self):
        return len(self.samples)

    def __getitems__(self, indices):
        return [self.samples[n] for n in indices]


def test_fields_of_all_groups_become_tensors():
    """Of every type, at its bounds."""
    rng, lidar, grid = np.random.default_rng(0), Lidar(rows=2, columns=3), GridSpec(shape=(4, 5, 6))
    schema = Schema(grid=grid, lidar=lidar, groups=tuple(GROUPS)[1:], scans=3)

    def draw(name):
        kind, shape = np.dtype(FIELDS[name]["dtype"]), schema.shape(name)
        if kind.kind == "f" or kind.kind == "b":
            return rng.normal(size=shape).astype(kind)
        values = rng.choice([np.iinfo(kind).min, np.iinfo(kind).max], shape).astype(kind)
        return values if shape else int(values)

    drawn = [Sample(**{name: draw(name) for name in schema.names}) for _ in range(3)]
    kept = Kept(drawn, schema)
    check_batches(DataLoader(kept.torch(), batch_size=2), kept, FIELDS)


def test_a_stream_gives_batches_in_its_own_order():
    stream = scenegen.stream(small_recipe(), seed=3, samples=12)
    loader = DataLoader(stream.torch("observed"), batch_sampler=stream.batches(2))
    for batch, numbers in zip(loader, stream.batches(2), strict=True):
        assert_array_equal(batch["observed"], [stream[n].observed for n in numbers])


def test_fields_of_several_shapes_are_left_out_by_name():
    recipe = small_recipe()
    parts = [recipe, replace(recipe, lidar=Lidar(rows=4, columns=12))]
    stream = scenegen.stream(parts, samples=4)
    line = refuses("two rasters", stream.torch)
    alike = eval(line.partition("fields=")[2].partition("]")[0] + "]")
    assert set(alike) == set(GROUPS[""]) - {"ranges"}
    (batch,) = DataLoader(stream.torch(alike), batch_size=4)
    assert batch["tudf"].shape == (4, *stream.grid.shape)


def test_what_cannot_be_is_said_in_a_line(samples, monkeypatch):
    refuses("tsdf", samples.torch, ["tsdf"])
    for name in ("scenegen.draw.tensors", "torch"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    refuses("no torch", samples.torch)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_plain_loader_of_samples_names_the_method(samples, workers):
    for each in (samples, scenegen.stream(small_recipe(), samples=4)):
        batches = iter(DataLoader(each, batch_size=2, num_workers=workers))
        with pytest.raises(TypeError, match=r"give DataLoader `samples\.torch\(\)`"):
            next(batches)
        # the error keeps the iterator, whose processes a later test would wait for
        getattr(batches, "_shutdown_workers", lambda: None)()
    assert len(next(iter(DataLoader(samples, batch_size=2, collate_fn=list)))) == 2
