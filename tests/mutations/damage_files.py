"""Family ``files``: scans, maps, plans and logs damaged anywhere, or of other words where they are
text; what files promise and do not hold is in tests/scenegen/clouds."""

from pathlib import Path

import numpy as np

from tests.mutations.case import Attempt, words
from tests.mutations.damage_bytes import damage
from tests.mutations.damage_weights import holds as holds_completion
from tests.mutations.datasets import finite_prediction
from tests.mutations.nasty import ESCAPES, REAL
from tests.mutations.valid import INGEST

SCAN = "scan {} --pose 0.2,0.2,0.2,0 --quiet -o a.ply"
COMMANDS = {
    "scan": ("complete {} --weights n.safetensors --quiet --device cpu -o out.h5",),
    "map": ("inspect {} --json", SCAN),
    "plan": ("map {} --quiet -o a.npz", SCAN),
    "log": ("ingest {} " + INGEST,),
}
"""What reads the files whose names begin so."""
MAKES = {"complete": ("out.h5",), "scan": ("a.ply",), "map": ("a.npz",)}
MAKES["ingest"] = ("out", "out/*", "out.part*")
OF_WORDS = (".txt", ".tum", ".yaml", ".xyz", ".ply", ".bt", ".ot")
"""Files that are text, or begin with it."""


def attempt(random, valid, here):
    """A damaged file, read by a command."""
    kind = random.choice(list(COMMANDS))
    name = random.choice(sorted(one.name for one in valid.folder.glob(f"{kind}.*")))
    path = valid.put(name, here)
    valid.put("n.safetensors", here)
    if kind == "plan":  # a picture, and the YAML that the commands read
        valid.put({".yaml": "plan.pgm", ".pgm": "plan.yaml"}[path.suffix], here)
        name = "plan.yaml"
    if path.is_dir():
        path = random.choice([one for one in sorted(path.rglob("*")) if one.is_file()])
    content = path.read_bytes()
    if path.suffix in OF_WORDS and random.random() < 0.5:
        said = random.choice((*map(repr, REAL), ESCAPES, "1 2", "", "[" * 999))
        parts = content.split(b" ", 100)
        parts[random.randrange(len(parts))] = said.encode()
        content = b" ".join(parts)
    else:
        content, said = damage(content, random)
    path.write_bytes(content)
    command = words(random.choice(COMMANDS[kind]).format(name))
    after, holds = RESULTS.get(command[0], (None, lambda result: ""))
    return Attempt(
        words=command,
        damage=f"{path.relative_to(here)}: {ascii(said)[:80]}",
        makes=MAKES.get(command[0], ()),
        after=after,
        holds=holds,
    )


def _completion():
    return finite_prediction(Path("out.h5"))


def _states():
    from scenegen.worlds.place import read_place

    found = [read_place(path).voxels.states for path in sorted(Path("out").glob("place*"))]
    return [np.bincount(states.ravel(), minlength=3).tolist() for states in found]


def _holds_map(result):
    return "" if result.after and all(map(any, result.after)) else "made a map of nothing"


RESULTS = {"complete": (_completion, holds_completion), "ingest": (_states, _holds_map)}
"""What a command left, and what is wrong with that."""
