"""Tables of figures in Markdown."""

from collections.abc import Collection, Iterable, Mapping
from typing import Any


def head(names: Collection[str]) -> list[str]:
    """The first two lines of a table whose first column has no name."""
    return [f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]


def line(name: str, cells: Iterable[str]) -> str:
    """A row: its name and its cells."""
    return f"| {name} | {' | '.join(cells)} |"


def cell(figure: Mapping[str, Any]) -> str:
    """A figure with its spread and interval, and its threshold; a dash where nothing was
    measured."""
    if not figure["n"]:
        return "–"
    return f"{spread(figure['mean'], figure['std'])} {interval(figure, '.3f')}{threshold(figure)}"


def threshold(figure: Mapping[str, Any]) -> str:
    """At which threshold a figure stands, where that is its own."""
    return f" at {figure['at']}" if figure.get("at") else ""


def interval(figure: Mapping[str, Any], form: str) -> str:
    """[low, high], or a dash where one world gives none."""
    return "[–]" if figure["low"] is None else f"[{figure['low']:{form}}, {figure['high']:{form}}]"


def spread(mean: float, std: float | None) -> str:
    """A mean with its standard deviation, where there is one."""
    return f"{mean:.3f}" if std is None else f"{mean:.3f} ± {std:.3f}"
