"""Every benchmark runs, as small as it can be, and its figures are there, and are numbers."""

import importlib
import re
import runpy
import sys
from pathlib import Path

import pytest

from scenegen.worlds.recipe import preset
from tests.command_line import ROOT, code_of, rows
from tests.conftest import dataset_in

BENCHMARKS = ROOT / "benchmarks"
SHARED = {"argoverse", "mazes", "measuring", "places", "posterior", "scoring", "served"}
NUMBER = r"(\d[\d.]*)"
SCRIPTS = {}
"""Of every benchmark: what it is given, and figures that it prints; N stands for one."""
for _command, _figure in rows(Path(__file__).with_name("figures.txt").read_text(encoding="utf-8")):
    SCRIPTS.setdefault(_command, []).append(_figure)
LEARNED = {
    *("elsewhere", "generalisation", "inference", "networks"),
    *("anywhere", "ceiling", "peers", "real", "training"),
}
"""These import torch, which takes seconds: they run in this process, which has done so for other
tests, and so do the commands that they run."""
DEAR = LEARNED | {
    *(
        "crowds",
        "decisions",
        "extras",
        "fly",
        "folders",
        "generate",
        "intervals",
        "kinds",
        "noise",
    ),
    *("movers", "mutants", "suite", "verify"),
}
"""These take some seconds."""


def test_every_benchmark_is_here():
    named = {command.split()[0] for command in SCRIPTS}
    assert {path.stem for path in BENCHMARKS.glob("*.py")} == named | SHARED


@pytest.fixture(scope="session")
def data(once):
    """Maps of the size that the bundled networks take, of one world a split."""

    def fill(folder):
        recipe, counts = preset("pillar"), {"train": 2, "val": 1, "test": 2}
        dataset_in(folder, recipe, counts=counts)

    return once("benchmarked", fill)


def in_this_process(*words):
    """Run the command of scenegen that a benchmark measures."""
    assert words[:2] == ("-m", "scenegen")
    assert code_of(*words[2:]) == 0


def marks(command):
    return [pytest.mark.slow] * (command.split()[0] in DEAR)


@pytest.mark.parametrize("command", [pytest.param(one, marks=marks(one)) for one in SCRIPTS])
def test_a_benchmark_runs_and_prints_its_figures(
    command, data, tmp_path, shell, monkeypatch, capsys
):
    name, *words = command.split()
    script = str(BENCHMARKS / f"{name}.py")
    places = {"DATA": data, "BENCHMARKS": BENCHMARKS}
    for name_of, place in places.items():
        words = [word.replace(name_of, str(place)) for word in words]
    given = [*words, "--smoke"]
    if name in LEARNED:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [script, *given])
        monkeypatch.syspath_prepend(BENCHMARKS)
        monkeypatch.setenv("OMP_WAIT_POLICY", "passive")  # which they set
        monkeypatch.setattr(importlib.import_module("measuring"), "run", in_this_process)
        runpy.run_path(script, run_name="__main__")
        said = capsys.readouterr().out
    else:
        ended = shell.python(script, *given, here=tmp_path)
        assert ended.code == 0, ended.err
        said = ended.out
    assert not re.search(r"\b(nan|inf)\b", said)
    for figure in SCRIPTS[command]:
        assert re.search(figure.replace("N", NUMBER), said), f"no {figure!r} in {said}"
