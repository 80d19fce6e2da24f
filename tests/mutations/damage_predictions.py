"""Family ``predictions``: HDF5 files of other numbers, types and layouts; rows, names and
attributes are in test_predicted.py."""

from collections.abc import Callable
from random import Random

import h5py
import numpy as np

from tests.mutations import damage_hdf5
from tests.mutations.case import REFUSED, SAME, VALID, Attempt, refuses, words
from tests.mutations.damage_bytes import damage
from tests.mutations.valid import scores

FIELDS = ("occupancy_probability", "tudf")
Damage = Callable[[h5py.File, Random], tuple[str, str]]


def attempt(random, valid, here):
    """A file of predictions, damaged, in a row of the bench."""
    valid.put("d", here)
    path = valid.put("predictions.h5", here)
    kind = random.random()
    if kind < 0.15:
        content, said = damage(path.read_bytes(), random)
        path.write_bytes(content)
        expected = VALID
    else:
        with h5py.File(path, "r+") as file:
            change = _numbers if kind < 0.4 else _structure
            said, expected = change(file, random)

    def same(result):
        if expected == SAME and scores(result.folder / "bench") != valid.scored:
            return "other scores than without the damage"
        return ""

    return Attempt(
        words=(
            *words("bench d --quick --workers 1 --quiet --method returns --predictions"),
            path.name,
        ),
        damage=f"{path.name}: {said}",
        makes=("bench", "bench/*"),
        holds=refuses(said) if expected == REFUSED else same,
    )


def _numbers(file, random):
    name = random.choice(FIELDS)
    value = random.choice((7.0, -3.0, -0.5, 1e38, np.nan, np.inf, -np.inf, 1.0001, 2.5))
    values = file[name][()]
    if random.random() < 0.5:
        values[...] = value
    else:
        values[-1, 3, 3, 3] = value
    file[name][...] = values
    fits = name == "tudf" and value in (1.0001,)
    return f"{name} holds {value}", VALID if fits or (name == "tudf" and value > 2) else REFUSED


def _structure(file, random):
    """What the family ``hdf5`` does to shards."""
    name = random.choice((*FIELDS, "world", "viewpoint"))
    change = random.choice(damage_hdf5.STRUCTURAL)
    if change in damage_hdf5.OF_CHUNKS:
        name = random.choice(FIELDS)
    said, expected = change(file, name, random)
    return f"{name} {said}", VALID if change is damage_hdf5.other_type else expected
