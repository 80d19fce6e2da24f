"""Family ``manifest``: JSON that says other things, or things in another order."""

import json

from tests.mutations.case import SAME, VALID, Attempt
from tests.mutations.dataset_commands import read_dataset
from tests.mutations.nasty import spoil


def attempt(random, valid, here):
    """The manifest, damaged."""
    name = random.choice("dc")
    folder = valid.put(name, here)
    path = folder / "dataset.json"
    tree = json.loads(path.read_text())
    if random.random() < 0.2:
        random.shuffle(tree["shards"])
        done = "entries shuffled"
    else:
        done = "; ".join(spoil(tree, random) for _ in range(random.choice((1, 1, 1, 2, 5))))
    content = json.dumps(tree)
    path.write_bytes(content.encode(errors="surrogatepass"))
    return _read(random, valid, here, name, f"{name}/dataset.json: {done}", content)


def _read(random, valid, here, name, done, content):
    attempt = read_dataset(random, valid, here, name, done, VALID if "shuffled" in done else SAME)
    if attempt.words[0] != "verify":
        return attempt
    original = json.loads((valid.folder / name / "dataset.json").read_text())

    def unchanged(result):
        found = json.loads(content)  # keys that nobody knows say nothing
        return (
            ""
            if {key: found.get(key) for key in original} == original
            else f"passed, in spite of: {done}"
        )

    return Attempt(words=attempt.words, damage=done, makes=attempt.makes, holds=unchanged)
