"""Commands that read a damaged dataset, each with what may come of it."""

import json
from functools import partial
from pathlib import Path

from tests.mutations import datasets
from tests.mutations.case import REFUSED, SAME, Attempt, refuses, words
from tests.mutations.valid import GENERATE

ALL = words("load load inspect quick verify resume world")


def read_dataset(random, valid, here, name, damage, expected):
    """A command at random on the dataset `name` in `here`, damaged in the way that `damage` says.

    `expected` is what exit code 0 may mean to readers; `verify` may pass nothing but unchanged
    samples, and `generate` must put back every byte, unless the manifest vouches for what is there.
    """
    return _COMMANDS[random.choice(ALL)](random, valid, here, name, damage, expected)


def _holds(expected, same, damage):
    if expected == REFUSED:
        return refuses(damage)
    return same if expected == SAME else lambda result: ""


def _load(random, valid, here, name, damage, expected):
    def same(result):
        return "" if result.stdout.strip() == valid.loaded[name] else "load gave other samples"

    return Attempt(words=("load", name), damage=damage, holds=_holds(expected, same, damage))


def _inspect(random, valid, here, name, damage, expected):
    def same(result):
        found = json.loads(result.stdout)["splits"]
        return "" if found == valid.inspected[name]["splits"] else "inspect gave other figures"

    asked = words(f"inspect {name} --json")
    return Attempt(words=asked, damage=damage, holds=_holds(expected, same, damage))


def _verify(random, valid, here, name, damage, expected, *, quick=False):
    truth = datasets.stored(valid.folder / name, derived=not quick)
    return Attempt(
        words=words(f"verify {name} --workers 1 --quiet{' --quick' * quick}"),
        damage=damage,
        after=lambda: datasets.stored(Path(name), derived=not quick),
        holds=lambda result: "" if result.after == truth else "verify passed other samples",
    )


def _resume(random, valid, here, name, damage, expected):
    valid.put("recipe.toml", here)

    def same(result):
        if "signed again" in damage:
            return ""  # the manifest vouches for it
        changed = [
            file for file, digest in valid.files[name].items() if result.after.get(file) != digest
        ]
        return f"generate went on and left another {', '.join(changed)}" if changed else ""

    return Attempt(
        words=words(f"{GENERATE} {name}{' --compact' * (name == 'c')}"),
        damage=damage,
        makes=(f"{name}/*",),
        after=lambda: datasets.files_of(Path(name)),
        holds=same,
    )


def _world(random, valid, here, name, damage, expected):
    return Attempt(
        words=words(f"world {name} {random.choice((0, 0, 1, 7))} -o w.xml"),
        damage=damage,
        makes=("w.*", "w/*", "w"),
    )


_COMMANDS = {
    "load": _load,
    "inspect": _inspect,
    "quick": partial(_verify, quick=True),
    "verify": _verify,
    "resume": _resume,
    "world": _world,
}
