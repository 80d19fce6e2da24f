"""What a command prints: results on standard output, progress and notes on standard error. All that
comes from files is escaped here."""

import os
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import Any

import rich_click as click

from scenegen.base.errors import escaped, plural, printable
from scenegen.base.executors import undone_if_stopped

ENDLESS = 1 << 30
"""Columns of what is no terminal."""
BARS = "▁▂▃▄▅▆▇█"
"""From low to high."""
MOST_BARS = 60
"""Bars of a curve."""
SHOW_CURSOR = b"\x1b[?25h\n"
"""Undoes what a progress bar does to a terminal."""


REASONS = {
    "no_flight": "no collision-free flight",
    "few_solids": "too few solids near the flight",
    "few_viewpoints": "too few viewpoints could be used",
    "few_returns": "too few rays return",
    "few_occupied": "too few voxels are occupied",
    "few_known": "too few voxels are known",
    "rays_unknown": "too many rays cross unknown space",
}
"""Why worlds and viewpoints are rejected while drawing, by the reason that the manifest gives."""


def seconds_taken() -> float:
    """How long the current command has taken so far, its imports included."""
    context: Any = click.get_current_context()
    return time.perf_counter() - context.obj


def say(text: object) -> None:
    """Prints lines; control characters in them are escaped."""
    for line in str(text).split("\n"):
        click.echo(escaped(line))


def note(text: object) -> None:
    """Says something beside the command's result."""
    print(printable(text), file=sys.stderr)


def show_table(
    rows: Mapping[str, Any], title: str = "", marks: Mapping[str, tuple[str, str]] | None = None
) -> None:
    """Prints a line for each of `rows`, name and value; `marks` stand before the values, text and
    colour by name."""
    if title:
        say(f"\n{escaped(title)}")
    width = max((len(escaped(name)) for name in rows), default=0)
    for name, value in rows.items():
        text, colour = (marks or {}).get(name, ("", "reset"))
        mark = f"{click.style(text, fg=colour)}  " if text else ""
        click.echo(f"{click.style(escaped(name).ljust(width), bold=True)}  {mark}{escaped(value)}")


def show_columns(
    rows: Mapping[str, Sequence[str]],
    heads: Sequence[str],
    title: str = "",
    meanings: Mapping[str, str] | None = None,
) -> None:
    """Prints a line for each of `rows`, a name and a cell under each of `heads`, and what it means
    behind the last one; one table below another where the terminal is too narrow for all
    columns."""
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
        for name, cells in ((" " * first, heads), *rows.items()):
            shown = (cells[n].rjust(widths[n]) for n in range(begin, end))
            meaning = (meanings or {}).get(name, "") if end == len(heads) else ""
            say(f"{escaped(name).ljust(first)}{''.join(shown)}  {meaning}".rstrip())
        begin = end


def curve(values: Sequence[float]) -> str:
    """Numbers as a line of bars, the least the lowest; of more than `MOST_BARS` as many,
    evenly spread."""
    if len(values) > MOST_BARS:
        values = [values[n * (len(values) - 1) // (MOST_BARS - 1)] for n in range(MOST_BARS)]
    least, height = min(values), max(values) - min(values)
    step = (len(BARS) - 1) / (height or 1)
    return "".join(BARS[round((value - least) * step)] for value in values)


def per_split(counts: Mapping[str, int]) -> str:
    """Counts in words: "train 40, val 4"."""
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def rejections(rejected: Mapping[str, Mapping[str, int]]) -> str:
    """What was rejected while drawing, in words."""
    parts = [
        f"{plural(count, what)}: {f'{REASONS[reason]} ({reason})' if reason in REASONS else reason}"
        for what, counts in rejected.items()
        for reason, count in counts.items()
    ]
    return "; ".join(parts) or "none"


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, names joined by dots."""
    rows: dict[str, Any] = {}
    for name, value in values.items():
        rows |= (
            flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
        )
    return rows


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Nested tables as one, see `flat`, with lists and numbers for people."""
    return {name: _plain(value) for name, value in flat(values).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return ", ".join(str(_plain(item)) for item in value) or "none"
    return f"{value:.4g}" if isinstance(value, float) else value


def announce_compilation() -> None:
    """Says why a run takes longer: the first one, or every one where kernels cannot be kept."""
    from lidarsim.jit import cache_trouble, no_kernels

    trouble = cache_trouble("scenegen")
    if trouble:
        note(f"compiling kernels, 6 to 15 seconds; they cannot be kept: {trouble} …")
    elif no_kernels("scenegen"):
        note("compiling kernels: once on this machine, 6 to 15 seconds …")


class Progress:
    """A bar of what is done, the rate and the time left. It runs a thread, so it begins after the
    workers."""

    def __init__(self, label: str, *, shown: bool):
        self._label, self._shown, self._done = label, shown, 0
        self._bar: Any = None
        self._begun = ExitStack()

    def __enter__(self) -> "Progress":
        self._begun.enter_context(undone_if_stopped(self._leave))
        self._begun.callback(self.stop)
        return self

    def __exit__(self, *error: object) -> None:
        self._begun.close()

    def start(self, total: int) -> None:
        """Shows a bar of `total` samples, of which those counted before the first bar are done."""
        self.restart(self._label, total, 0 if self._bar is not None else self._done)

    def restart(self, label: str, total: int, done: int) -> None:
        """Shows a new bar of `total` samples, `done` of them already."""
        self.stop()
        self._label, self._done = label, done
        if not self._shown:
            return
        from rich import progress
        from rich.console import Console

        self._bar = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[rate]}"),
            progress.TimeRemainingColumn(),
            # notebooks ask for colours, which rich takes for a terminal
            console=Console(stderr=True, force_terminal=sys.stderr.isatty()),
        )
        self._begin, self._at_begin = time.perf_counter(), done
        self._task = self._bar.add_task(escaped(label), total=total, completed=done, rate="")
        self._bar.start()

    def stop(self) -> None:
        """Leaves the bar as it stands."""
        if self._bar is not None:
            self._bar.stop()

    def note(self, text: str) -> None:
        """Shows `text` behind the label."""
        if self._bar is not None:
            self._bar.update(self._task, description=escaped(f"{self._label} {text}"))

    def count(self, samples: int) -> None:
        """Counts samples as done."""
        self._done += samples
        if self._bar is not None:
            rate = (self._done - self._at_begin) / max(time.perf_counter() - self._begin, 1e-9)
            self._bar.update(self._task, completed=self._done, rate=f"{rate:.1f} a second")

    def _leave(self) -> None:
        """For a stop: the bar's thread and locks are let be."""
        if self._bar is not None and os.isatty(2):
            with suppress(OSError):
                os.write(2, SHOW_CURSOR)


Tell = Callable[[Any], bool]
"""What prints a command's result as JSON, if that is asked for, and says whether to show it to
people; it is given the result, or what makes one that takes time."""
