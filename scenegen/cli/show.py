"""Results as people read them. All that comes from files is escaped here."""

import shutil
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import rich_click as click

from scenegen.errors import escaped

ENDLESS = 1 << 30
"""Columns of what is no terminal."""
BARS, PLAIN_BARS = "▁▂▃▄▅▆▇█", "_.-=*#"
"""From low to high; the second where the terminal has no others."""


def say(text: object = "") -> None:
    """Print lines; control characters in them are escaped."""
    for line in str(text).split("\n"):
        click.echo(escaped(line))


def show_table(
    rows: Mapping[str, Any], title: str = "", marks: Mapping[str, tuple[str, str]] | None = None
) -> None:
    """A line for each of `rows`, name and value; `marks` stand before the values, text and colour
    by name."""
    if title:
        say(f"\n{escaped(title)}")
    width = max((len(escaped(name)) for name in rows), default=0)
    for name, value in rows.items():
        text, colour = (marks or {}).get(name, ("", "reset"))
        mark = f"{click.style(text, fg=colour)}  " if text else ""
        click.echo(f"{click.style(escaped(name).ljust(width), bold=True)}  {mark}{escaped(value)}")


def show_figures(rows: Mapping[str, Sequence[str]], heads: Sequence[str], title: str = "") -> None:
    """A line for each of `rows`, a name and a cell under each of `heads`; one table below another
    where the terminal is too narrow for all columns."""
    if title:
        say(f"\n{title}")
    first = max(len(escaped(name)) for name in rows)
    widths = [
        2 + max(map(len, (head, *cells)))
        for head, *cells in zip(heads, *rows.values(), strict=True)
    ]
    wide = shutil.get_terminal_size((ENDLESS, 24)).columns
    begin = 0
    while begin < len(heads):
        end = begin + 1
        while end < len(heads) and first + sum(widths[begin : end + 1]) <= wide:
            end += 1
        columns = range(begin, end)
        say(" " * first + "".join(heads[n].rjust(widths[n]) for n in columns))
        for name, cells in rows.items():
            say(escaped(name).ljust(first) + "".join(cells[n].rjust(widths[n]) for n in columns))
        begin = end


def curve(values: Sequence[float], *, most: int = 60) -> str:
    """Numbers as a line of bars, the least the lowest; of more than `most` as many, evenly
    spread."""
    shown = (
        [values[n * (len(values) - 1) // max(most - 1, 1)] for n in range(most)]
        if len(values) > most
        else values
    )
    least, height = min(shown), max(shown) - min(shown)
    try:
        BARS.encode(sys.stdout.encoding or "ascii")
        bars = BARS
    except UnicodeEncodeError:
        bars = PLAIN_BARS
    return "".join(
        bars[round((value - least) / (height or 1) * (len(bars) - 1))] for value in shown
    )


def per_split(counts: Mapping[str, int]) -> str:
    """Counts in words: "train 40, val 4"."""
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def rejections(rejected: Mapping[str, Mapping[str, int]]) -> str:
    """What was rejected while drawing, in words."""
    parts = [f"{what} {per_split(counts)}" for what, counts in rejected.items() if counts]
    return "; ".join(parts) or "none"


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, names joined by dots."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        found |= (
            flat(value, f"{prefix}{name}.")
            if isinstance(value, dict)
            else {f"{prefix}{name}": value}
        )
    return found
