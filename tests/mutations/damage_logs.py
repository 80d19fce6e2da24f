"""Family ``logs``: a file of a log damaged anywhere, and poses that are numbers of all sorts."""

from pathlib import Path

import numpy as np

from tests.mutations.case import Attempt, words
from tests.mutations.damage_bytes import damage
from tests.mutations.nasty import ESCAPES, REAL
from tests.mutations.valid import INGEST

LOGS = ("log", "log", "log.mcap", "livox.mcap")


def attempt(random, valid, here):
    """A damaged log, ingested."""
    name = random.choice([one for one in LOGS if (valid.folder / one).exists()])
    path = valid.put(name, here)
    if path.is_dir():
        path = random.choice([one for one in sorted(path.rglob("*")) if one.is_file()])
    if path.suffix in (".txt", ".tum") and random.random() < 0.5:
        said = random.choice((*map(repr, REAL), ESCAPES, "1 2", ""))
        numbers = path.read_text().split(" ")
        numbers[random.randrange(len(numbers))] = said
        path.write_text(" ".join(numbers))
    else:
        content, said = damage(path.read_bytes(), random)
        path.write_bytes(content)
    return Attempt(
        words=("ingest", name, *words(INGEST)),
        damage=f"{path.relative_to(here)}: {ascii(said)[:80]}",
        makes=("out", "out/*", "out.part*"),
        after=_states,
        holds=_holds,
    )


def _states():
    from scenegen.worlds.place import read_place

    found = [read_place(path).voxels.states for path in sorted(Path("out").glob("place*"))]
    return [np.bincount(states.ravel(), minlength=3).tolist() for states in found]


def _holds(result):
    return "" if result.after and all(map(any, result.after)) else "made a map of nothing"
