"""Every benchmark runs, as small as it can be, and its figures are there, and are numbers."""

import importlib
import re
import runpy
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from scenegen.recipe import preset
from tests.command_line import code_of
from tests.conftest import dataset_in

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SHARED = {"measuring", "recordings", "scoring", "served"}
STUDY = BENCHMARKS.parent / "docs" / "results" / "study.json"
DATA = "data"
"""Stands for a dataset's folder."""
NUMBER = r"(\d[\d.]*)"
ODOMETRY = r"pillar +N m  N scans  N %" if find_spec("kiss_icp") else "not measured: kiss-icp"
SCRIPTS = {
    "anywhere": ((), (r"`geometric`, the default sensor \| N .* \| N", r"points alone \| – \| N")),
    "costs": ((), (r"missed: inside \| N % \| N", r"invented: elsewhere \| +\| N")),
    "elsewhere": ((), (r"default range:0\.05 \| N", r"scaffold, all sensors; careful \| [+-]N")),
    "extras": ((), (r"the core \| N \|", r"`\[train\]` \| N \|")),
    "fly": ((), (r"`optimistic` \| N", r"`tortuosity` \| N")),
    "folders": (
        (),
        (
            r"--version` \| N, N \|",
            r"resume, unlisted \| N, N \|",
            r"merge \| N, N \| N \| N \|",
        ),
    ),
    "generalisation": (("--out", "out"), (r"extrude: maze N", r"without maze: maze N")),
    "generate": (
        (),
        (
            "N samples a second and core",
            "everything else",
            r"--compact: N samples in N s .* N s of proc",
        ),
    ),
    "gpu": ((), (r"pillar +N M rays/s +N samples/s", r" (0) values differ")),
    "inference": ((), (r"occ +stem 2:  eager +N ms", r"openvino +N ms")),
    "intervals": ((), (r"success, geometric +N +N +N",)),
    "kinds": (
        ("--difficulty", "easy", "--difficulty", "hard"),
        (
            r"`geometric` \| N \| N% · N% \| N% · N \|",
            r"`maze` \| N · N \| N · N \| N · N; N% · N%",
        ),
    ),
    "mutants": ((), (r"N of 1 killed",)),
    "odometry": ((), (ODOMETRY,)),
    "peers": ((), (r"`pillar` \| N .* \| N", r"`SSC.et` \| N M \| 0.92 M \| N M \| N \| N")),
    "rays": ((), (r"analytic +N ms a scan", r"kernels cached: N s")),
    "real": ((), (r"`pillar` \| N \| N .* \| N", r"mean of the places")),
    "rehearsal": ((), (r"N nodes, a bucket \| N \| N \|", "N requests")),
    "sensors": ((), (r"livox-avia +N ms a sample", r"map ahead +N ms a sample")),
    "stream": ((), (r"generate --compact +N \(1\.00\) +N", r"cache read +N \(N\) +N")),
    "study": ((STUDY, "--out", "out"), (r"out/(c)laims\.png", r"out/(l)earning\.png")),
    "training": (
        (DATA,),
        (
            r"loader, one process: N samples/s",
            r"float32 +N ms a map, N of processor; +bfloat16 +N ms",
        ),
    ),
    "verify": (
        (DATA,),
        (r": N samples, (no) check failed", r"by processor time +N samples a second"),
    ),
}
"""Of every benchmark: what it is given, and figures that it prints; N stands for one."""
LEARNED = {
    *("costs", "elsewhere", "generalisation", "inference"),
    *("anywhere", "peers", "real", "training"),
}
"""These import torch, which takes seconds: they run in this process, which has done so for other
tests, and so do the commands that they run."""
DEAR = LEARNED | {
    *("extras", "fly", "folders", "generate", "rehearsal"),
    *("gpu", "mutants", "study", "verify"),
}
"""These take some seconds."""


def test_every_benchmark_is_here():
    assert {path.stem for path in BENCHMARKS.glob("*.py")} == SCRIPTS.keys() | SHARED


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


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if name in DEAR else name for name in SCRIPTS],
)
def test_a_benchmark_runs_and_prints_its_figures(
    name,
    data,
    tmp_path,
    shell,
    monkeypatch,
    capsys,
):
    words, figures = SCRIPTS[name]
    script = str(BENCHMARKS / f"{name}.py")
    given = [*(str(data if word == DATA else word) for word in words), "--smoke"]
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
    for figure in figures:
        assert re.search(figure.replace("N", NUMBER), said), f"no {figure!r} in {said}"
