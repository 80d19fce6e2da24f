"""Commands that read a damaged dataset, each with what may come of it."""

from functools import partial
from pathlib import Path

from tests.mutations.case import REFUSED, SAME, Attempt, words
from tests.mutations.datasets import digest_of, files_of
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
    line = LINES[command].format(name, number=random.choice((0, 0, 1, 7)))
    after, is_fine = None, lambda result: True
    if command == "resume":
        valid.put("recipe.toml", here)
        line += " --compact" * (name == "c")
        if "signed again" not in damage:
            files = valid.files[name].items()
            after = partial(files_of, Path(name))
            is_fine = lambda result: files <= result.after.items()  # noqa: E731
    elif command in ("quick", "verify"):
        derived = command == "verify"
        after = partial(digest_of, name, derived=derived)
        is_fine = lambda result: result.after == valid.loaded[name][derived]  # noqa: E731
    elif command == "load" and expected == SAME:
        is_fine = lambda result: result.stdout.strip() == valid.loaded[name][True]  # noqa: E731
    elif command != "world":
        is_fine = lambda result: expected != REFUSED  # noqa: E731
    return Attempt(
        words=words(line),
        damage=damage,
        makes=words(MAKES.get(command, "").format(name)),
        after=after,
        holds=lambda result: "" if is_fine(result) else f"{command} passed it: {damage}",
    )
