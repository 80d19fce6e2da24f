"""The campaign as a test: a few cases of every family always, thousands where asked for."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mutations.families import FAMILIES

pytestmark = pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in ("torch", "onnx")),
    reason="needs torch and onnx",
)
ROOT = Path(__file__).parents[2]


def campaign(*words, seconds):
    """What the campaign prints; it runs in a process of its own, from which the cases are
    forked."""
    ended = subprocess.run(
        [sys.executable, "-m", "tests.mutations", *map(str, words)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )
    assert ended.returncode == 0, f"{ended.stdout}\n{ended.stderr[-3000:]}"
    return ended.stdout


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_so_do_thousands(family):
    cases = os.environ.get("SCENEGEN_MUTATIONS", "300")
    campaign(
        family,
        "--cases",
        cases,
        "--seed",
        os.environ.get("SCENEGEN_MUTATION_SEED", "1"),
        seconds=7200,
    )
