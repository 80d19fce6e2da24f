"""Reading from Python: lazily, with names, shapes and units, in any number of processes and
threads."""

import copy
import html
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.testing import assert_array_equal

import scenegen
from scenegen.dataset.layout import ShardFile
from scenegen.draw.sample import GROUPS, Sample
from tests.refusals import refuses
from tests.scenegen.conftest import same


def test_samples_come_lazily_and_described(made):
    split = scenegen.load(made)
    assert len(split) == 11
    assert split._open == {}
    sample, described = split[4], split.describe()
    assert len(split._open) == 1
    assert set(described) == set(GROUPS[""])
    for name, field in described.items():
        value = np.asarray(getattr(sample, name))
        assert value.dtype.name == field["dtype"], name
        assert value.shape == field["shape"], name
    metres = {name for name, field in described.items() if field["unit"] == "m"}
    assert metres == {"tudf", "ranges", "position", "origin"}
    refuses("training", scenegen.load, str(made), split="training")


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
    refuses("colour", getattr, sample, "colour", error=AttributeError)


def test_a_copy_of_a_sample_is_plain_and_whole(made):
    sample = scenegen.load(made)[5]
    for copied in (pickle.loads(pickle.dumps(sample)), copy.copy(sample)):
        assert type(copied) is Sample
        assert_array_equal(copied.points(), sample.points())
        assert same(copied, sample)


def test_many_threads_and_few_open_files_read_the_same(made, monkeypatch):
    monkeypatch.setattr("scenegen.dataset.read.MAX_OPEN", 2)
    split = scenegen.load(made)
    expected = [sample.sha256() for sample in split]
    assert len(split._open) == 2
    order = np.random.default_rng(0).integers(0, 11, 200).tolist()
    with ThreadPoolExecutor(8) as pool:
        digests = list(pool.map(lambda index: split[index].sha256(), order))
    assert digests == [expected[index] for index in order]
    assert len(split._open) == 2


def test_a_sample_without_a_dataset_needs_its_sensor(made):
    dataset = scenegen.load(made).dataset
    stored = dataset.split("train")[0]
    plain = Sample(**{name: getattr(stored, name) for name in GROUPS[""]})
    refuses("none", plain.points, error=TypeError)
    refuses("os1", stored.points, "os1")
    refuses("frame", stored.points, frame="sensor")
    assert_array_equal(plain.points(dataset.lidar), stored.points())


def test_samples_and_splits_say_what_they_are(dataset):
    split = scenegen.load(dataset.rename(dataset.with_name("<b>x")))
    guess = scenegen.Prediction(tudf=split[0].tudf)
    for shown in (split, split.dataset, guess, scenegen.stream("pillar")):
        assert "<b>x" not in shown._repr_html_()
        assert html.escape(repr(shown)) in shown._repr_html_()
    texts = split._repr_html_(), split[0]._repr_html_()
    assert all(f"<td>{name}</td>" in text for text in texts for name in GROUPS[""])
    assert set(GROUPS[""]) < set(dir(split[1]))
