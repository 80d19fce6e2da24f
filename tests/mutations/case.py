"""What a case is: a command on a damaged input, and what counts as a good end."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

SAME, VALID, REFUSED = "same", "valid", "refused"
"""What exit code 0 may mean: the samples of the undamaged input; any valid result; nothing, it must
not be."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Result:
    """How a case ended."""

    code: int
    """Exit code; -1 where the process was ended."""
    seconds: float
    failure: str = ""
    """Why the process was ended."""
    left_running: bool = False
    stdout: str = ""
    stderr: str = ""
    after: Any = None
    """What `Attempt.after` found, where the command ended with 0."""
    grown_bytes: int = 0
    """Most memory that the process had beyond the one it was forked from."""
    changed: tuple[str, ...] = ()
    """Files of the working folder that appeared, changed or vanished."""
    folder: Path = Path()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attempt:
    """One command line on a damaged input. Paths are relative to the case's own folder, where it
    runs."""

    words: tuple[str, ...]
    """Of the command line; ``load FOLDER`` stands for `scenegen.load` on all splits."""
    damage: str
    """What was done to the input, for people."""
    makes: tuple[str, ...] = ()
    """Patterns of the files that the command may make or replace."""
    after: Callable[[], Any] | None = None
    """Run in the command's process when that ended with 0; what it returns, as JSON, goes to
    `holds`."""
    holds: Callable[[Result], str] = lambda result: ""
    """What is wrong with a result of exit code 0: a sentence, or nothing."""
    may_lack_memory: bool = False
    """Whether "out of memory" is a good end: the user asked for much, no stranger did."""


def words(line):
    """A command line's words."""
    return tuple(line.split())


def refuses(damage):
    """For damage that must not go unnoticed."""
    return lambda result: f"was taken, in spite of: {damage}"
