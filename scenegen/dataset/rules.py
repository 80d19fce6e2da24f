"""Rules for what a stranger's manifest says, held against it before anybody relies on it, and how
samples are numbered."""

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any

from scenegen import SPLITS
from scenegen.errors import BrokenError, NewerError, short
from scenegen.files import Json
from scenegen.limits import MOST_SAMPLES, MOST_SEED, MOST_SOURCES


@dataclass(frozen=True, kw_only=True)
class Numbering:
    """The rule of docs/format.md, for one split. A place may be one number, or an array of them."""

    viewpoints: int
    """Samples of one flight."""
    scenes: int | None
    """Worlds from MJCF files, which flights visit in turn; None where each flight has a world of
    its own."""

    def name(self, place: Any) -> tuple[Any, Any]:
        """(world, viewpoint) of the sample at `place`."""
        unit, view = place // self.viewpoints, place % self.viewpoints
        if self.scenes is None:
            return unit, view
        return unit % self.scenes, unit // self.scenes * self.viewpoints + view

    def place(self, world: Any, viewpoint: Any) -> Any:
        """The place of the sample that is `viewpoint` of `world`."""
        if self.scenes is None:
            return world * self.viewpoints + viewpoint
        turn, view = viewpoint // self.viewpoints, viewpoint % self.viewpoints
        return (turn * self.scenes + world) * self.viewpoints + view

    def count(self, samples: int) -> int:
        """How many worlds the first so many samples are of."""
        units = -(-samples // self.viewpoints)
        return units if self.scenes is None else min(units, self.scenes)


@dataclass(frozen=True)
class Rule:
    """What a value may be, as a test and in words."""

    fits: Callable[[Any], bool]
    words: str


FLAG = Rule(lambda value: isinstance(value, bool), "true or false")
TABLE = Rule(lambda value: isinstance(value, dict), "a table")
LIST = Rule(lambda value: isinstance(value, list), "a list")


def whole(least: int, most: int) -> Rule:
    """Whole numbers from `least` to `most`."""
    return Rule(
        lambda value: type(value) is int and least <= value <= most,
        f"a whole number from {least} to {most}",
    )


def text(pattern: str, words: str) -> Rule:
    """Texts that match the whole `pattern`, which `words` describe."""
    matches = re.compile(pattern).fullmatch
    return Rule(lambda value: isinstance(value, str) and matches(value) is not None, words)


DIGEST = text("[0-9a-f]{64}", "a SHA-256, 64 hexadecimal digits")


def optional(rule: Rule) -> Rule:
    """What `rule` allows, or null."""
    return Rule(lambda value: value is None or rule.fits(value), f"{rule.words}, or null")


def table_of(rule: Rule) -> Rule:
    """Tables whose values are as `rule` says, whatever they are called."""
    return Rule(
        lambda value: isinstance(value, dict) and all(map(rule.fits, value.values())),
        f"a table, each value {rule.words}",
    )


def check(found: Any, rules: Mapping[str, Rule], at: str, known: Collection[str] = ()) -> None:
    """Raise BrokenError unless `found` is a table that has all that `rules` name, each as its rule
    says, and, where names are `known`, NewerError if it has others.

    `at` is where the table stands in the file, such as ``shards.3``, empty for the whole; it begins
    the error.
    """
    if not isinstance(found, Mapping):
        raise BrokenError(f"{at} = {short(found)}: expected a table")
    for name, rule in rules.items():
        where = f"{at}.{name}" if at else name
        if name not in found:
            raise BrokenError(f"{where} is missing: expected {rule.words}")
        if not rule.fits(found[name]):
            raise BrokenError(f"{where} = {short(found[name])}: expected {rule.words}")
    for name in found if known else ():
        if name not in known:
            raise NewerError(f"{at}: unknown parameter {short(name)}: expected {', '.join(known)}")


def ruled(rule: Rule) -> Any:
    """A field of a dataclass whose values in a file are as `rule` says."""
    return field(metadata={"rule": rule})


def checked(kind: type, found: Any, at: str) -> Json:
    """The values in the table `found` of those fields of the dataclass `kind` that have a rule.
    Raises BrokenError."""
    rules = rules_of(kind)
    check(found, rules, at)
    return {name: found[name] for name in rules}


@cache  # a manifest lists up to a hundred thousand shards
def rules_of(kind: type) -> Mapping[str, Rule]:
    """The rules of a dataclass's fields, by their names."""
    return {item.name: item.metadata["rule"] for item in fields(kind) if "rule" in item.metadata}


_GIVEN = Rule(lambda value: True, "a value")


def made(
    part: Any, table: Any, at: str, names: Mapping[str, str] | None = None, *, needed: Any = None
) -> Any:
    """The dataclass `part` of a table that has the keys `needed`, or all, and whose keys may be
    `names` there. Raises BrokenError."""
    names = names or {item.name: item.name for item in fields(part)}
    check(table, dict.fromkeys(names if needed is None else needed, _GIVEN), at, names)
    try:
        return part(**{names[name]: value for name, value in table.items()})
    except ValueError as error:
        field, equals, rest = str(error).partition(" = ")
        name = next((name for name, ours in names.items() if ours == field), field)
        raise BrokenError(f"{at}.{name}{equals}{rest}") from None


COUNT = whole(0, MOST_SAMPLES)
REJECTED = dict.fromkeys(("worlds", "viewpoints"), table_of(COUNT))
"""Counts by reason, of what was rejected on the way to a shard or a dataset."""
TEXTS = table_of(Rule(lambda value: isinstance(value, str), "text"))
RECIPE_RULES = {
    "version": whole(0, MOST_SEED),
    "difficulty": optional(text(r"[\w .-]{1,60}", "a name such as hard")),
    "world": optional(TABLE),
    "flight": TABLE,
    "accept": TABLE,
    "scenes": Rule(
        lambda value: (
            value is None
            or (
                isinstance(value, dict)
                and value.keys() <= set(SPLITS)
                and all(
                    isinstance(worlds, list) and all(map(TEXTS.fits, worlds))
                    for worlds in value.values()
                )
            )
        ),
        "the worlds of each split",
    ),
}
FILE_RULE = text(
    r"(?:((?:train|val|test)-[0-9]+)x+/(?=\1))?(train|val|test)-[0-9]{5,9}(\.h5|\.worlds\.zip)",
    "such as train-00000.h5 or train-01xxx/train-01000.worlds.zip",
)
DIGITS = 3
"""As many last digits tell shards of one folder apart: the first thousand lie in the dataset's own,
every further thousand in one of theirs. The Hugging Face Hub takes 10,000 entries a folder."""


def stem_of(split: str, index: int) -> str:
    """What the files of a split's shard are called, less their endings. It depends on nothing else,
    so that a dataset grows and no file moves."""
    stem = f"{split}-{index:05d}"
    return f"{stem[:-DIGITS]}{'x' * DIGITS}/{stem}" if index >= 10**DIGITS else stem


def pattern_of(file: str) -> str:
    """What fits a file's name and those of all others of its sort, in which numbers differ."""
    return re.sub("-[0-9]+", "-*", file)


SOURCES_RULE = Rule(
    lambda value: isinstance(value, list) and 0 < len(value) <= MOST_SOURCES,
    "datasets, one at least",
)
