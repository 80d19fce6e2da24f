"""Prints results of commands on standard output, and progress and notes on standard error. Control
characters in texts from files are escaped here."""

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
"""Columns of an output that is not a terminal."""
BARS = "▁▂▃▄▅▆▇█"
"""Bars of a curve, from low to high."""
MAX_BARS = 60
"""Maximum number of bars of a curve."""
SHOW_CURSOR = b"\x1b[?25h\n"
"""Restores a terminal after a progress bar."""
Reporter = Callable[[Any], bool]
"""Prints the result of a command as JSON if the user wants that, and returns whether to print it
for people. Its argument is the result, or a function that makes it if that takes time."""
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
    """Return the time since the current command began, imports included."""
    context: Any = click.get_current_context()
    return time.perf_counter() - context.obj


def echo(text: object) -> None:
    """Print lines on standard output; control characters are escaped."""
    for line in str(text).split("\n"):
        click.echo(escaped(line))  # a file's name could hold commands for the terminal


def info(text: object) -> None:
    """Print a line on standard error, beside the command's result."""
    print(printable(text), file=sys.stderr)


def show_table(
    rows: Mapping[str, Any], title: str = "", marks: Mapping[str, tuple[str, str]] | None = None
) -> None:
    """Print a line for each row: name and value.

    Args:
        rows: Values by name.
        title: Line above, or "".
        marks: Text and colour of a mark before the value, by the row's name.
    """
    if title:
        echo(f"\n{escaped(title)}")
    # widths are those of escaped texts, which are longer
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
    """Print a table. If the terminal is too narrow for all columns, print several, one below the
    other.

    Args:
        rows: Cells by the name of the row.
        heads: Heads of the columns.
        title: Line above, or "".
        meanings: Text behind the last column, by the name of the row.
    """
    if title:
        echo(f"\n{title}")
    first = max(len(escaped(name)) for name in rows)
    widths = [
        2 + max(map(len, (head, *cells)))
        for head, *cells in zip(heads, *rows.values(), strict=True)
    ]
    # a file or a pipe has no width: tables stay whole for other programs
    wide = shutil.get_terminal_size((ENDLESS, 24)).columns
    begin = 0
    while begin < len(heads):
        end = begin + 1  # at least one column, however narrow the terminal is
        while end < len(heads) and first + sum(widths[begin : end + 1]) <= wide:
            end += 1
        for name, cells in ((" " * first, heads), *rows.items()):
            row = (cells[n].rjust(widths[n]) for n in range(begin, end))
            meaning = (meanings or {}).get(name, "") if end == len(heads) else ""
            echo(f"{escaped(name).ljust(first)}{''.join(row)}  {meaning}".rstrip())
        begin = end


def curve(values: Sequence[float]) -> str:
    """Return numbers as a line of bars, at most `MAX_BARS`, evenly spread."""
    if len(values) > MAX_BARS:
        values = [values[n * (len(values) - 1) // (MAX_BARS - 1)] for n in range(MAX_BARS)]
    low, height = min(values), max(values) - min(values)
    step = (len(BARS) - 1) / (height or 1)  # equal values: all bars are low
    return "".join(BARS[round((value - low) * step)] for value in values)


def per_split(counts: Mapping[str, int]) -> str:
    """Return counts as a text: "train 40, val 4"."""
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def rejections(rejected: Mapping[str, Mapping[str, int]]) -> str:
    """Return counts of rejected worlds and viewpoints, with reasons, as a text."""
    parts = [
        f"{plural(count, name)}: {f'{REASONS[reason]} ({reason})' if reason in REASONS else reason}"
        for name, counts in rejected.items()
        for reason, count in counts.items()
    ]
    return "; ".join(parts) or "none"


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables.

    Args:
        values: Values and tables by name.
        prefix: Text before each name.

    Returns:
        Values by their names, joined by dots.
    """
    rows: dict[str, Any] = {}
    for name, value in values.items():
        rows |= (
            flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
        )
    return rows


def plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten nested tables, see `flat`, and format lists and numbers for people."""
    return {name: _plain(value) for name, value in flat(values).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return ", ".join(str(_plain(item)) for item in value) or "none"
    return f"{value:.4g}" if isinstance(value, float) else value


def announce_compilation() -> None:
    """Print a note if kernels have to be compiled: in the first run on a machine, or in every run
    if they cannot be stored."""
    from lidarsim.jit import cache_trouble, no_kernels

    trouble = cache_trouble("scenegen")
    if trouble:
        info(f"compiling kernels, 6 to 15 seconds; they cannot be kept: {trouble} …")
    elif no_kernels("scenegen"):
        info("compiling kernels: once on this machine, 6 to 15 seconds …")


class ProgressBar:
    """A progress bar with rate and time left. It runs a thread, so start it after workers are
    forked."""

    def __init__(self, label: str, *, visible: bool):
        """Prepare a bar.

        Args:
            label: Text before the bar.
            visible: Whether the bar is shown.
        """
        self._label, self._visible, self._done = label, visible, 0
        self._bar: Any = None
        self._begun = ExitStack()

    def __enter__(self) -> "ProgressBar":
        # a stop ends the process in its signal handler, where `__exit__` does not run
        self._begun.enter_context(undone_if_stopped(self._leave))
        self._begun.callback(self.stop)
        return self

    def __exit__(self, *error: object) -> None:
        self._begun.close()

    def start(self, total: int) -> None:
        """Show a bar of `total` samples; those counted before the first bar are done."""
        self.restart(self._label, total, 0 if self._bar is not None else self._done)

    def restart(self, label: str, total: int, finished: int) -> None:
        """Show a new bar.

        Args:
            label: Text before the bar.
            total: Number of samples.
            finished: Number of samples that are done already.
        """
        self.stop()
        self._label, self._done = label, finished
        if not self._visible:
            return
        # slow to import, and not needed with --quiet or --json
        from rich import progress
        from rich.console import Console

        self._bar = progress.Progress(
            # brackets in the name of a folder are not markup
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[rate]}"),
            progress.TimeRemainingColumn(),
            # notebooks ask for colours, which rich takes for a terminal
            console=Console(stderr=True, force_terminal=sys.stderr.isatty()),
        )
        # the rate counts only what this run did
        self._begin, self._at_begin = time.perf_counter(), finished
        self._task = self._bar.add_task(escaped(label), total=total, completed=finished, rate="")
        self._bar.start()

    def stop(self) -> None:
        """End the bar, and leave it on the screen."""
        if self._bar is not None:
            self._bar.stop()

    def info(self, text: str) -> None:
        """Show a text behind the label."""
        if self._bar is not None:
            self._bar.update(self._task, description=escaped(f"{self._label} {text}"))

    def count(self, samples: int) -> None:
        """Count samples as done."""
        self._done += samples
        if self._bar is not None:
            rate = (self._done - self._at_begin) / max(time.perf_counter() - self._begin, 1e-9)
            self._bar.update(self._task, completed=self._done, rate=f"{rate:.1f} a second")

    def _leave(self) -> None:
        """Restore the terminal in a signal handler, where the bar's locks may be held."""
        if self._bar is not None and os.isatty(2):
            with suppress(OSError):
                os.write(2, SHOW_CURSOR)
