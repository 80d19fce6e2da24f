"""Commands that read a damaged dataset, each with what may come of it."""

import json
from functools import partial
from pathlib import Path

from tests.mutations import datasets
from tests.mutations.case import REFUSED, SAME, Attempt, words
from tests.mutations.valid import GENERATE

LINES = {
    "load": "load {}",
    "inspect": "inspect {} --json",
    "quick": "verify {} --workers 1 --quiet --quick",
    "verify": "verify {} --workers 1 --quiet",
    "resume": GENERATE + " {}",
    "world": "world {} {number} -o w.xml",
}
MAKES = {"resume": "{}/*", "world": "w.* w/* w"}


def read_dataset(random, valid, here, name, damage, expected):
    """A command at random on the dataset `name` in `here`, damaged in the way that `damage` says.

    `expected` is what exit code 0 may mean to readers; `verify` may pass nothing but unchanged
    samples, and `generate` must put back every byte, unless the manifest vouches for what is there.
    """
    command = random.choice((*LINES, "load"))
    if command == "resume":
        valid.put("recipe.toml", here)
    line = LINES[command].format(name, number=random.choice((0, 0, 1, 7)))
    after, is_same = _result(command, valid, name)
    vouched = command == "resume" and "signed again" in damage
    if vouched or (command in ("load", "inspect") and expected != SAME):
        fine = expected != REFUSED or vouched
        is_same = lambda result: fine  # noqa: E731
    return Attempt(
        words=words(line + " --compact" * (command == "resume" and name == "c")),
        damage=damage,
        makes=words(MAKES.get(command, "").format(name)),
        after=after,
        holds=lambda result: "" if is_same(result) else f"{command} passed it: {damage}",
    )


def _result(command, valid, name):
    """What is looked up after a command, and whether a result is the one without damage."""
    if command == "load":
        return None, lambda result: result.stdout.strip() == valid.loaded[name]
    if command == "inspect":
        splits = valid.inspected[name]["splits"]
        return None, lambda result: json.loads(result.stdout)["splits"] == splits
    if command == "resume":
        files = valid.files[name].items()
        return partial(datasets.files_of, Path(name)), lambda result: files <= result.after.items()
    if command == "world":
        return None, lambda result: True
    read = partial(datasets.stored, derived=command == "verify")
    truth = read(valid.folder / name)
    return partial(read, Path(name)), lambda result: result.after == truth
