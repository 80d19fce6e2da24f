"""The campaign as a test, where slow ones are asked for; it runs in a process of its own, from
which the cases are forked."""

import os

import pytest

from tests.command_line import ROOT, python

pytest.importorskip("torch")
pytest.importorskip("onnx")


@pytest.mark.slow
def test_every_case_ends_in_a_valid_result_or_one_line():
    cases, seed = (
        os.environ.get(f"SCENEGEN_{name}", usual)
        for name, usual in (("MUTATIONS", "300"), ("MUTATION_SEED", "1"))
    )
    words = ("-m", "tests.mutations", "--cases", cases, "--seed", seed)
    python(*words, cwd=ROOT, timeout=7200)
