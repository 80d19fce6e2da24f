"""Threads that wait for others sleep, unless the user says otherwise."""

import os
import re

import pytest

from tests.command_line import python

COMMAND = """
import rich_click as click


@click.command()
def load():
    from ctypes import CDLL
    from importlib.util import find_spec
    from pathlib import Path
    CDLL(next(Path(find_spec("torch").origin).parent.glob("lib/libgomp*")))
"""


@pytest.mark.parametrize(("given", "found"), [({}, "0"), ({"GOMP_SPINCOUNT": "7"}, "7")])
def test_torch_is_loaded_with_threads_that_wait_asleep(given, found, tmp_path):
    """As OpenMP itself says when torch's is loaded: how often a thread looks for work before it
    sleeps."""
    (tmp_path / "mine.py").write_text(COMMAND)
    environment = os.environ | {"OMP_DISPLAY_ENV": "verbose"}
    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        environment.pop(name, None)
    said = python("-m", "scenegen", "mine:load", cwd=tmp_path, env=environment | given).stderr
    assert re.findall(r"GOMP_SPINCOUNT = '(\d+)'", said) == [found]
