"""The campaign as a test, where slow ones are asked for; it runs in a process of its own, from
which the cases are forked."""

import os
import subprocess
import sys

import pytest

from tests.command_line import ROOT

pytest.importorskip("torch")
pytest.importorskip("onnx")


@pytest.mark.slow
def test_every_case_ends_in_a_valid_result_or_one_line():
    given = {"cases": ("MUTATIONS", "300"), "seed": ("MUTATION_SEED", "1")}
    words = [
        f"--{option}={os.environ.get(f'SCENEGEN_{name}', usual)}"
        for option, (name, usual) in given.items()
    ]
    ended = subprocess.run(
        [sys.executable, "-m", "tests.mutations", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=7200,
        check=False,
    )
    assert ended.returncode == 0, f"{ended.stdout}\n{ended.stderr[-3000:]}"
