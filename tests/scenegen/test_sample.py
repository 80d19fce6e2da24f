"""Samples and splits say what they are, and give their points."""

import html

import pytest
from numpy.testing import assert_array_equal

import scenegen
from scenegen.dataset.read import Dataset
from scenegen.draw.sample import GROUPS, Sample


def test_a_sample_without_a_dataset_needs_its_sensor(made):
    dataset = Dataset(made)
    stored = dataset.split("train")[0]
    plain = Sample(**{name: getattr(stored, name) for name in GROUPS[""]})
    with pytest.raises(TypeError, match="sensor"):
        plain.points()
    with pytest.raises(ValueError, match="sensor = 'os1'"):
        stored.points("os1")
    assert_array_equal(plain.points(dataset.lidar), stored.points())


def test_samples_and_splits_say_what_they_are(dataset):
    folder = dataset.rename(dataset.with_name("<b>x"))
    split = Dataset(folder).split("train")
    guess = scenegen.Prediction(tudf=split[0].tudf)
    for value in (split, split.dataset, guess, scenegen.stream("pillar")):
        said = value._repr_html_()
        assert "<b>x" not in said
        assert html.escape(repr(value)) in said
    texts = split._repr_html_(), split[0]._repr_html_()
    assert all(f"<td>{name}</td>" in text for text in texts for name in GROUPS[""])
    assert set(GROUPS[""]) < set(dir(split[1]))
    with pytest.raises(ValueError, match="expected 'world' or 'body'"):
        split[1].points(frame="sensor")  # type: ignore[arg-type]
