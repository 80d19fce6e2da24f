"""Family ``predictions``: HDF5 files of other types and layouts; numbers, rows, names and
attributes are in test_predicted.py."""

import h5py

from tests.mutations import damage_hdf5
from tests.mutations.case import REFUSED, SAME, VALID, Attempt, refuses, words
from tests.mutations.damage_bytes import damage
from tests.mutations.valid import BENCH, scores

FIELDS = ("occupancy_probability", "tudf")


def attempt(random, valid, here):
    """A file of predictions, damaged, in a row of the bench."""
    valid.put("d", here)
    path = valid.put("predictions.h5", here)
    if random.random() < 0.2:
        content, said = damage(path.read_bytes(), random)
        path.write_bytes(content)
        expected = VALID
    else:  # what the family ``hdf5`` does to shards
        change = random.choice(damage_hdf5.STRUCTURAL)
        whole = () if change in damage_hdf5.OF_CHUNKS else ("world", "viewpoint")
        name = random.choice((*FIELDS, *whole))
        with h5py.File(path, "r+") as file:
            said, expected = change(file, name, random)
        said = f"{name} {said}"
        expected = VALID if change is damage_hdf5.other_type else expected

    def same(result):
        if expected == SAME and scores(result.folder / "bench") != valid.scored:
            return "other scores than without the damage"
        return ""

    return Attempt(
        words=words(BENCH),
        damage=f"{path.name}: {said}",
        makes=("bench", "bench/*"),
        holds=refuses(said) if expected == REFUSED else same,
    )
