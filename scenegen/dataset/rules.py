"""A stranger's JSON, held against rules before anybody relies on it; what is wrong is said in words
of our own."""

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any, TypeVar

from scenegen.errors import BrokenError, NewerError, short

T = TypeVar("T")


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


def checked(kind: type, found: Any, at: str) -> dict[str, Any]:
    """The values in the table `found` of those fields of the dataclass `kind` that have a rule.
    Raises BrokenError."""
    rules = _rules_of(kind)
    check(found, rules, at)
    return {name: found[name] for name in rules}


@cache  # a manifest lists up to a hundred thousand shards
def _rules_of(kind: type) -> Mapping[str, Rule]:
    return {item.name: item.metadata["rule"] for item in fields(kind) if "rule" in item.metadata}


def made(part: type[T], table: Any, names: Mapping[str, str], at: str) -> T:
    """The dataclass `part` of a table whose keys `names` are called otherwise there. Raises
    BrokenError."""
    check(table, {}, at, names)
    try:
        return part(**{names[name]: value for name, value in table.items()})
    except ValueError as error:
        said = str(error)
        for name, ours in names.items():
            said = said.replace(ours, name)
        raise BrokenError(f"{at}.{said}") from None
