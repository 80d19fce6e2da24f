"""A law over all fields that a sample may have: what a stream gives first is what `generate` gives,
whoever draws it, and whether or not a folder has kept it."""

import dataclasses

import h5py
import numpy as np
import pytest
from torch.utils.data import DataLoader

import scenegen
from scenegen.dataset.build import build, plan_dataset
from scenegen.draw.parts.normals import Normals
from scenegen.draw.sample import FIELDS, GROUPS
from scenegen.draw.source import DrawnWorlds, read_scenes
from scenegen.streams.mixture import Component
from scenegen.worlds.labels import labels_by
from tests.conftest import hall_in, scene_recipe, small_recipe
from tests.scenegen.worlds.test_place import hall

COUNTS = {"train": 6, "val": 0, "test": 0}
SEVERAL = {"scans": 3, "tilt_mps": 3.0, "map_ahead_m": (1.5, 0.2, -0.3), "fusion": "log-odds"}


def drawn(recipe):
    return recipe, DrawnWorlds(recipe)


def of_a_map(folder):
    source = read_scenes(hall_in(folder, hall()), COUNTS, seed=0)
    return source.suited(scene_recipe()), source


EXAMPLES = {
    "": lambda folder: drawn(small_recipe(noise={"stages": "range:0.02,dropout:0.05"})),
    "earlier": lambda folder: drawn(small_recipe("geometric", mapping=SEVERAL)),
    "labels": lambda folder: drawn(
        dataclasses.replace(
            small_recipe("warehouse", mapping={"scans": 2}),
            parts={"labels": labels_by("class", ())},
        )
    ),
    "normals": lambda folder: drawn(
        dataclasses.replace(small_recipe(), parts={"normals": Normals()})
    ),
    "known": of_a_map,
}
"""What makes samples that have the fields of a group: a recipe, and where its worlds come from."""


@pytest.mark.parametrize("group", GROUPS)
def test_streams_give_every_field_as_generate_stores_it(group, tmp_path, monkeypatch):
    """What is stored is read by h5py alone."""
    recipe, source = EXAMPLES[group](tmp_path)
    build(plan_dataset(tmp_path / "d", recipe, source, seed=4, counts=COUNTS))
    with h5py.File(tmp_path / "d" / "train-00000.h5") as shard:
        stored = {name: shard[name][()] for name in FIELDS if name in shard}
    assert stored.keys() == {
        name for key in GROUPS if GROUPS[key][0] in stored for name in GROUPS[key]
    }
    assert set(GROUPS[group]) <= stored.keys()
    assert [name for name in GROUPS[group] if len(np.unique(stored[name])) < 2] in ([], ["world"])

    def check(samples):
        assert len(samples) == COUNTS["train"]
        for n, sample in enumerate(samples):
            assert sample.names == tuple(stored)
            for name in FIELDS:
                value, expected = getattr(sample, name), stored.get(name, [None] * len(samples))[n]
                got, due = np.asarray(value), np.asarray(expected)
                assert (name, got.dtype, got.shape) == (name, due.dtype, due.shape)
                assert np.array_equal(got, due), name

    component = Component(
        label="it", recipe=recipe, source=source, seed=4, split="train", engine="analytic"
    )

    def streamed(**options):
        return scenegen.stream(component, samples=COUNTS["train"], **options)

    check(list(streamed()))
    helped = streamed(workers=1)
    check(list(helped))
    helped.close()
    check(
        [
            one
            for batch in DataLoader(streamed(), 2, num_workers=2, collate_fn=list)
            for one in batch
        ]
    )
