"""A law over all fields that a sample may have: what a stream gives first is what `generate` gives,
whoever draws it, and whether or not a folder has kept it."""

import itertools
from dataclasses import replace

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from torch.utils.data import DataLoader

import scenegen
from lidarsim.noise.chain import Noise
from scenegen.dataset.build import build, plan_dataset
from scenegen.dataset.read import Dataset
from scenegen.draw.parts.normals import Normals
from scenegen.draw.sample import FIELDS, GROUPS
from scenegen.draw.source import DrawnWorlds, read_scenes
from scenegen.streams.mixture import Component
from scenegen.worlds.labels import labels_by
from scenegen.worlds.traffic import Traffic
from tests.conftest import hall_in, picky_recipe, scene_recipe, small_recipe
from tests.scenegen.worlds.test_place import hall

CLASSES = labels_by("class", ())
COUNTS = {"train": 6, "val": 0, "test": 0}
SEVERAL = {"scans": 3, "tilt_mps": 3.0, "map_ahead_m": (1.5, 0.2, -0.3), "fusion": "log-odds"}


TWO = {"scans": 2}
RECIPES = {
    "": replace(picky_recipe(), noise=Noise.parse("range:0.02")),
    "earlier": small_recipe("geometric", mapping=SEVERAL),
    "labels": replace(small_recipe("warehouse", mapping=TWO), parts={"labels": CLASSES}),
    "normals": replace(small_recipe(), parts={"normals": Normals()}),
    "movers": replace(small_recipe(mapping=TWO), parts={"movers": Traffic(people=(8, 10))}),
}
"""Samples that have the fields of a group; those of `known` are of a map."""


@pytest.mark.parametrize("group", GROUPS)
def test_streams_give_every_field_as_generate_stores_it(group, tmp_path, monkeypatch):
    """What is stored is read by h5py alone."""
    if group == "known":
        source = read_scenes(hall_in(tmp_path, hall()), COUNTS, seed=0)
        source, recipe = source.suited(scene_recipe())
    else:
        source = DrawnWorlds(recipe := RECIPES[group])
    build(plan_dataset(tmp_path / "d", recipe, source, seed=4, counts=COUNTS))
    with h5py.File(tmp_path / "d" / "train-00000.h5") as shard:
        stored = {name: shard[name][()] for name in FIELDS if name in shard}
    assert set(GROUPS[group]) <= stored.keys()
    assert [name for name in GROUPS[group] if len(np.unique(stored[name])) < 2] in ([], ["world"])

    def check(samples):
        for n, sample in enumerate(samples):
            assert sample.names == tuple(stored)
            for name, values in stored.items():
                actual = np.asarray(getattr(sample, name))
                assert actual.dtype == values.dtype, name
                assert_array_equal(actual, values[n], name, strict=True)
        assert n + 1 == COUNTS["train"]

    component = Component(
        label="it", recipe=recipe, source=source, seed=4, split="train", engine="analytic"
    )

    def streamed(**options):
        return scenegen.stream(component, samples=COUNTS["train"], **options)

    assert streamed().describe() == Dataset(tmp_path / "d").split("train").describe()
    backwards = [streamed()[n] for n in reversed(range(COUNTS["train"]))]
    check(backwards[::-1])
    helped = streamed(workers=1)
    check(helped)
    helped.close()
    check(itertools.chain(*DataLoader(streamed(), 2, num_workers=2, collate_fn=list)))
