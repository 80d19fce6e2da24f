"""Reading from Python: lazily, with names, shapes and units, in any number of processes and
threads."""

import copy
import dataclasses
import hashlib
import multiprocessing
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import scenegen
from scenegen.dataset.layout import ShardFile
from scenegen.draw.sample import GROUPS, Sample
from tests.scenegen import refuses


def digest(task):
    """All of a sample's fields, in whatever process this runs."""
    split, index = task
    sample = split[index]
    return hashlib.sha256(
        b"".join(np.asarray(getattr(sample, name)).tobytes() for name in GROUPS[""])
    ).hexdigest()


def test_samples_come_lazily_and_described(made):
    split = scenegen.load(made)
    assert len(split) == 11
    assert split._open == {}
    sample, described = split[4], split.describe()
    assert len(split._open) == 1
    assert set(described) == set(GROUPS[""])
    for name, field in described.items():
        value = np.asarray(getattr(sample, name))
        assert (value.dtype.name, value.shape) == (field["dtype"], field["shape"]), name
        assert field["meaning"]
    metres = {name for name, field in described.items() if field["unit"] == "m"}
    assert metres == {"tudf", "ranges", "position", "origin"}
    assert len(scenegen.load(str(made), split="test")) == 4
    refuses("has no split 'training'", scenegen.load, made, split="training")


def test_a_field_accessed_is_a_field_read_and_read_once(made, monkeypatch):
    read = []
    original = ShardFile.value

    def value(shard, name, row, **options):
        read.append(name)
        return original(shard, name, row, **options)

    monkeypatch.setattr(ShardFile, "value", value)
    sample = scenegen.load(made)[7]
    assert read == []
    assert sample.occupancy is sample.occupancy
    assert sample.ranges.shape == (8, 24)
    assert read == ["occupancy", "ranges"]
    with pytest.raises(AttributeError, match="has no field 'colour'; it has observed, free"):
        sample.colour  # type: ignore[attr-defined]  # noqa: B018


def test_a_copy_of_a_sample_is_plain_and_whole(made):
    sample = scenegen.load(made)[5]
    for other in (
        pickle.loads(pickle.dumps(sample)),
        copy.copy(sample),
        dataclasses.replace(sample, world=0),
    ):
        assert type(other) is Sample
        assert other.names == sample.names
        assert_array_equal(other.points(), sample.points())
        assert np.array_equal(other.tudf, sample.tudf)
    assert copy.copy(sample).sha256() == sample.sha256()


def test_many_processes_read_what_one_reads(made):
    """Forked ones with its open files, and those that a split travels to as bytes."""
    split = scenegen.load(made)
    asked = [(split, index) for index in range(11)]
    expected = list(map(digest, asked))  # which opens files in this process
    with multiprocessing.get_context("fork").Pool(2) as pool:
        found = pool.map(digest, asked, chunksize=1)
        pool.close()
        pool.join()
    sent = pickle.loads(pickle.dumps(split))
    for order in (split, sent):
        assert found == [digest((order, index)) for index in range(11)] == expected


def test_many_threads_and_few_open_files_read_the_same(made, monkeypatch):
    monkeypatch.setattr("scenegen.dataset.read.MAX_OPEN", 2)
    split = scenegen.load(made)
    expected = [digest((split, index)) for index in range(11)]
    assert len(split._open) == 2
    order = np.random.default_rng(0).integers(0, 11, 200).tolist()
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(digest, [(split, index) for index in order]))
    assert found == [expected[index] for index in order]
    assert len(split._open) == 2
