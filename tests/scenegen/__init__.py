"""What is refused, and in which words: a file beside the tests of each room."""

from pathlib import Path

import pytest

from scenegen.base.errors import ScenegenError
from tests.command_line import beside, rows


def cases(name):
    """Rows of a room's `refusals.txt`, refused or not: `room/heading`, or a heading alone."""
    room, _, heading = name.rpartition("/")
    text = beside(__file__, Path(room, "refusals.txt"))
    return rows(text.split(f"\n== {heading}\n")[1].partition("\n==")[0])


def each_case(name, columns, read=str):
    """Runs a test for each row of `cases(name)`; its columns, read in some way, are arguments."""
    values = [[read(text) for text in row] for row in cases(name)]
    return pytest.mark.parametrize(columns.split(), values)


def refuses(told, action, *given, **more):
    """Do what cannot be done: it ends in one of our errors, whose line, as every test sees to, is
    one, and says this."""
    with pytest.raises(ScenegenError, match=told):
        action(*given, **more)
