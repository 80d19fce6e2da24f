"""How far a command has come, on standard error."""

import os
import sys
import time
from contextlib import ExitStack, suppress
from typing import Any

from scenegen.errors import escaped, printable
from scenegen.run import undone_if_stopped

SHOW_CURSOR = b"\x1b[?25h\n"
"""Undoes what a progress bar does to a terminal."""


def note(text: object) -> None:
    """Say something beside the command's result."""
    print(printable(text), file=sys.stderr)


def announce_compilation() -> None:
    """Say why a run takes longer: the first one, or every one where kernels cannot be kept."""
    from lidarsim.jit import cache_folder, cache_trouble

    trouble = cache_trouble("scenegen")
    if trouble:
        note(f"compiling kernels, about 20 seconds; they cannot be kept: {trouble} …")
    elif not any(cache_folder("scenegen").rglob("*.nbc")):
        note("compiling kernels: once on this machine, about 20 seconds …")


class Progress:
    """A bar of samples, rate and time left. It runs a thread, so it begins after the workers."""

    def __init__(self, label: str, *, shown: bool):
        self._label = label
        self._shown = shown
        self._done = 0
        self._bar: Any = None
        self._begun = ExitStack()

    def __enter__(self) -> "Progress":
        self._begun.enter_context(undone_if_stopped(self._leave))
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        self._begun.close()

    def stop(self) -> None:
        """Leave the bar as it stands."""
        if self._bar is not None:
            self._bar.stop()

    def start(self, total: int) -> None:
        """Show the bar, of `total` samples less those counted already."""
        if not self._shown:
            return
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
        )

        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._begin, self._at_begin = time.perf_counter(), self._done
        self._task = self._bar.add_task(
            escaped(self._label), total=total, completed=self._done, rate=""
        )
        self._bar.start()

    def restart(self, label: str, total: int, done: int) -> None:
        """Show a new bar of `total` samples, `done` of them already."""
        self.stop()
        self._label, self._done = label, done
        self.start(total)

    def note(self, text: str) -> None:
        """Show `text` behind the label."""
        if self._bar is not None:
            self._bar.update(self._task, description=escaped(f"{self._label} {text}"))

    def count(self, samples: int) -> None:
        """Count samples as done."""
        self._done += samples
        if self._bar is not None:
            rate = (self._done - self._at_begin) / max(time.perf_counter() - self._begin, 1e-9)
            self._bar.update(self._task, completed=self._done, rate=f"{rate:.0f} samples/s")

    def _leave(self) -> None:
        """For a stop: the bar's thread and locks are let be."""
        if self._bar is not None and os.isatty(2):
            with suppress(OSError):
                os.write(2, SHOW_CURSOR)
