"""The command line as users meet it, for tests: run a command in this process, on small worlds."""

import shlex
import sys
from pathlib import Path

import pytest

from scenegen import __main__ as cli

ROOT = Path(__file__).parents[1]
SMALL = """
kind = "pillar"
[world]
size_m = [16, 16, 8]
[flight]
viewpoints = 3
margin_m = 2
min_distance_m = 4
[accept]
min_solids = 1
[lidar]
rows = 8
columns = 24
[grid]
shape = [24, 24, 16]
"""


def run(capsys, *words):
    """Exit code, standard output and standard error of a command: its words, or one line as a user
    types it."""
    if len(words) == 1:
        words = tuple(shlex.split(str(words[0])))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONSAFEPATH", "1")  # as the command line has it, and as it was afterwards
        patch.setattr(sys, "argv", ["scenegen", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out, said.err


def refused(capsys, *words):
    """The one line in which a command ends that cannot be done; see `run`."""
    code, said, line = run(capsys, *words)
    assert (code in (1, 2), said, line.count("\n")) == (True, "", 1), line
    return line


def rows(table):
    """The rows of a table that is written as text, with an arrow between its columns."""
    return [tuple(map(str.strip, line.split("→"))) for line in table.strip().splitlines()]
