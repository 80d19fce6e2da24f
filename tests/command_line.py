"""The command line as users meet it, for tests: run a command in this process, on small worlds."""

import re
import shlex
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from scenegen import __main__ as cli

ROOT = Path(__file__).parents[1]


def beside(file, name):
    """The text of a file that lies beside a test."""
    return (Path(file).parent / name).read_text(encoding="utf-8")


SMALL = beside(__file__, "small.toml")


def code_of(*words):
    """The exit code of a command that runs in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONSAFEPATH", "1")  # as the command line has it, and as it was afterwards
        patch.setattr(sys, "argv", ["scenegen", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
    return int(ended.value.code or 0)


def run(capsys, *words):
    """Exit code, standard output and standard error of a command: its words, or one line as a user
    types it."""
    code = code_of(*(words if len(words) > 1 else shlex.split(str(words[0]))))
    said = capsys.readouterr()
    return code, said.out, said.err


def done(capsys, *words):
    """What a command prints, which ends well; with --quiet it prints nothing. See `run`."""
    code, said, error = run(capsys, *words)
    assert code == 0, error
    assert "--quiet" not in " ".join(map(str, words)) or not said + error
    return said


def refused(capsys, *words):
    """The one line in which a command ends that cannot be done; see `run`."""
    code, said, line = run(capsys, *words)
    assert (code in (1, 2), said, line.count("\n")) == (True, "", 1), line
    return line


def process(*words, timeout=600, **more):
    """How a process ends, which ends well."""
    words, how = list(map(str, words)), {"capture_output": True, "text": True, "check": False}
    ended = subprocess.run(words, timeout=timeout, **how, **more)
    assert ended.returncode == 0, f"{ended.stdout[-2000:]}\n{ended.stderr[-4000:]}"
    return ended


python = partial(process, sys.executable)


def modules_after(code):
    """The modules that a process of its own has imported by the end of some code."""
    told = "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr))"
    return set(python("-c", f"{told}\n{code}", cwd=ROOT).stderr.split())


def page(name):
    """The text of a page of the docs."""
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def example(name, words):
    """The one block of code on a page of the docs that holds some words."""
    blocks = re.findall(r"```\w+\n(.*?)```", page(name), re.DOTALL)
    (found,) = (block for block in blocks if words in block)
    return found


def rows(table):
    """The rows of a table that is written as text, with an arrow between its columns."""
    return [tuple(map(str.strip, line.split("→"))) for line in table.strip().splitlines()]
