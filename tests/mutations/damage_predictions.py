"""Family ``predictions``: HDF5 files of other numbers, names, rows, types and attributes."""

from collections.abc import Callable
from random import Random

import h5py
import numpy as np

from tests.mutations import damage_hdf5
from tests.mutations.case import REFUSED, SAME, VALID, Attempt, refuses, words
from tests.mutations.damage_bytes import damage
from tests.mutations.nasty import ESCAPES
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
            change = (
                random.choice((_numbers, _numbers, _rows, _attributes, _names))
                if kind < 0.6
                else _structure
            )
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


def _rows(file, random):
    match random.randrange(5):
        case 0:
            file["viewpoint"][:] = file["viewpoint"][0]
            return "every row the same sample", REFUSED
        case 1:
            for name in (*FIELDS, "world", "viewpoint"):
                values = file[name][()]
                del file[name]
                file[name] = np.concatenate([values, values])
            return "every row twice", REFUSED
        case 2:
            name = random.choice((*FIELDS, "world", "viewpoint"))
            values = file[name][()]
            del file[name]
            file[name] = values[:1]
            return f"one row of {name}", REFUSED
        case 3:
            order = [1, 0]
            for name in (*FIELDS, "world", "viewpoint"):
                file[name][...] = file[name][()][order]
            return "rows in another order", SAME
        case _:
            name = random.choice(("world", "viewpoint"))
            value = random.choice(
                (
                    np.array([0.5, 1.5]),
                    np.array([b"0", b"1"]),
                    np.array([[0, 1]]),
                    np.array([np.nan, 0.0]),
                )
            )
            del file[name]
            file[name] = value
            return f"{name} = {value.tolist()}", REFUSED


def _attributes(file, random):
    key = random.choice(("dataset", "split", "method"))
    texts = (ESCAPES.replace("\x00", ""), "", "x" * 60_000)
    value = random.choice(
        (None, 3, np.arange(3), ["a", "b"], np.bytes_(b"\xff"), h5py.Empty("f4"), *texts)
    )
    if value is None:
        del file.attrs[key]
    else:
        file.attrs[key] = value
    return f"attribute {key} = {ascii(value)[:60]}", SAME if key == "method" else REFUSED


def _names(file, random):
    match random.randrange(4):
        case 0:
            name = random.choice((*FIELDS, "world", "viewpoint"))
            del file[name]
            return f"no {name}", VALID if name in FIELDS else REFUSED
        case 1:
            name = random.choice((*FIELDS, "world", "viewpoint"))
            file.move(name, ESCAPES.replace("\x00", "").replace("/", ""))
            return f"{name} under another name", VALID if name in FIELDS else REFUSED
        case 2:
            file[FIELDS[0] + "s"] = file[FIELDS[0]]
            return "one name more", SAME
        case _:
            for name in list(file):
                del file[name]
            return "nothing", REFUSED


def _structure(file, random):
    """What the family ``hdf5`` does to shards."""
    name = random.choice((*FIELDS, "world", "viewpoint"))
    change = random.choice(damage_hdf5.STRUCTURAL)
    if change in damage_hdf5.OF_CHUNKS:
        name = random.choice(FIELDS)
    said, expected = change(file, name, random)
    return f"{name} {said}", VALID if change is damage_hdf5.other_type else expected
