"""Parameters as plain JSON values, what they describe, and where two sets of them differ."""

import json
import re
from dataclasses import fields
from typing import Any

from lidarsim.parameters import MOST_SHOWN
from scenegen.errors import BrokenError, NewerError, raised_as, short
from scenegen.files import Json


def plain(value: Any) -> Any:
    """`value` as JSON would give it back."""
    return json.loads(json.dumps(value))


def configured(config: Any, table: Any, where: str) -> Any:
    """The dataclass `config` of a `table` of its fields; errors name `where` in the file that is.

    Raises:
        NewerError: The table has other names, too.
        BrokenError: A value cannot be.
    """
    known = {item.name for item in fields(config)}
    for name in table:
        if name not in known:
            raise NewerError(
                f"{where}: unknown parameter {short(name)}: expected {', '.join(sorted(known))}"
            )
    with raised_as(BrokenError, f"{where}.", of=(ValueError, TypeError)):
        return config(**table)


def differences(
    stored: Json, asked: Json, words: tuple[str, str] = ("there", "asked for"), prefix: str = ""
) -> list[str]:
    """Where two sets of parameters differ.

    Args:
        stored: The first set.
        asked: The second set.
        words: What the values of the first and of the second set are called.
        prefix: Stands before every name.

    Returns:
        Lines such as "grid.voxel_m is 0.2 there, 0.1 asked for": nested names are joined by dots,
        and the items of a list of tables named by their places.
    """
    lines = []
    for name in [*stored, *(name for name in asked if name not in stored)]:
        old, new = (_numbered(table.get(name, "absent")) for table in (stored, asked))
        if isinstance(old, dict) and isinstance(new, dict):
            lines += differences(old, new, words, f"{prefix}{name}.")
        elif old != new:
            lines.append(
                f"{short(f'{prefix}{name}')[1:-1]} is {_shown(old)} {words[0]}, "
                f"{_shown(new)} {words[1]}"
            )
    return lines


def _numbered(value: Any) -> Any:
    """A list of tables as a table of them by their places; anything else as it is."""
    tables = isinstance(value, list) and value and isinstance(value[0], dict)
    return dict(enumerate(value)) if tables else value


def _shown(value: Any) -> str:
    """A parameter as JSON writes it, cut where it is long; of digests, the first digits."""
    text = re.sub(r'"(\w{8})\w{56}"', r'"\1…"', json.dumps(value))
    return text if len(text) <= MOST_SHOWN else f"{text[: MOST_SHOWN - 3]}..."
