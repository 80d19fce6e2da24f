"""Refusals keep a law: an error is one printable line. The wording of all of them stands in one
file, `wording.txt`, and is compared as text.

`SCENEGEN_WORDING=new python -m pytest ...` writes the lines of the tests that run; look at the
difference. A `…` in the file stands for any text, such as a message of Python's own.
"""

import fcntl
import os
import re
from pathlib import Path

import pytest

from scenegen.base.errors import ScenegenError
from tests.command_line import ROOT, refused

FILE = Path(__file__).with_name("wording.txt")
BASE = [str(ROOT)]
"""Folders that are written as `~`; conftest adds that of temporary files."""


def check_wording(case, line):
    """Hold the line of a refusal to the law, and to its wording in the file."""
    assert line.isprintable(), f"not one printable line: {line!r}"
    test = os.environ["PYTEST_CURRENT_TEST"].partition("[")[0].split(" ")[0]
    name = _anywhere(f"{test.removeprefix('tests/')} {' '.join(str(case).split())}")
    line = _anywhere(line)
    with FILE.open("a+", encoding="utf-8") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        said = dict(row.rstrip("\n").split(" → ", 1) for row in file)
        if os.environ.get("SCENEGEN_WORDING") == "new" and not _fits(said.get(name), line):
            said[name] = line
            file.truncate(0)
            file.write("".join(f"{name} → {said[name]}\n" for name in sorted(said)))
    assert _fits(said.get(name), line), f"{name} → {line}\nexpected {said.get(name)}"


def _anywhere(text):
    for folder in sorted(BASE, key=len, reverse=True):
        text = re.sub(rf"{re.escape(folder)}(/popen-gw\d+)?", "~", text)
    return re.sub(r"~/test_\w+?\d+\b", "~", text)


def _fits(expected, line):
    parts = map(re.escape, (expected or "").split("…"))
    return expected is not None and re.fullmatch(".*".join(parts), line) is not None


def refuses(case, act, *given, error=(ValueError, ScenegenError), **more):
    """`act` of what is given raises an `error` that keeps the law; its line."""
    with pytest.raises(error) as caught:
        act(*given, **more)
    check_wording(case, str(caught.value))
    return str(caught.value)


def refuses_command(capsys, words, case=None):
    """A command ends in one line, prints nothing else, and keeps the law; its line."""
    line = refused(capsys, words).rstrip("\n")
    check_wording(case or words, line)
    return line
