"""The command line as a whole: what it loads, how it ends, and what it lets nobody print."""

import json
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import mujoco
import pytest

from scenegen import __version__
from tests.command_line import ROOT, run


def test_version_completion_and_doctor(capsys: pytest.CaptureFixture[str]) -> None:
    assert __version__ in run(capsys, "--version")[1]
    assert "_SCENEGEN_COMPLETE" in run(capsys, "completion", "bash")[1]
    code, said, _ = run(capsys, "doctor", "--json")
    found = json.loads(said)
    assert code == 0
    assert found["ok"]
    assert found["self_test"]["returns_occupied"]
    assert found["self_test"]["repeatable"]
    assert found["software"]["mujoco"] == mujoco.__version__


def test_help_loads_nothing_heavy() -> None:
    heavy = "mujoco", "numba", "h5py", "ompl", "scipy", "numpy", "pydantic"
    code = f"import sys, cli; sys.exit(', '.join(name for name in {heavy!r} if name in sys.modules) or 0)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_printing_in_vain_changes_no_verdict(small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Output that is lost is told and ends with 1; nobody need read standard error, nor all of the output."""
    out = tmp_path / "d"
    assert run(capsys, "generate", "--recipe", small, "--n", 3, "--out", out, "--workers", 1, "--quiet")[0] == 0
    verify = f"{sys.executable} cli.py verify --quick {out}"
    script = f"{sys.executable} cli.py completion bash"
    lost = "scenegen: standard output: {}; what was to be printed is lost\n".format
    expected = {
        f"{verify} 2>/dev/full >/dev/null": (0, ""),
        f"{script} >&-": (1, lost("Bad file descriptor")),
        f"{script} >/dev/full": (1, lost("No space left on device")),
        f"({script}; echo $? >&2) | true": (0, "0\n"),
    }
    root = ROOT
    running = [subprocess.Popen(words, shell=True, cwd=root, stderr=subprocess.PIPE, text=True) for words in expected]
    for process, (command, (code, error)) in zip(running, expected.items(), strict=True):
        assert (process.communicate(timeout=120)[1], process.returncode) == (error, code), command


def test_names_from_files_print_no_lines_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    forged = "x\nscenegen: verify: all 17 checks passed\x1b[32m"
    (tmp_path / forged).mkdir()
    (tmp_path / forged / "dataset.json").write_text(json.dumps({"format": forged}))
    for words in (("inspect", tmp_path / forged), ("verify", tmp_path / forged), ("train", "--variant", forged)):
        code, said, error = run(capsys, *words)
        assert code
        for line in (said + error).splitlines():
            assert line.isprintable()
            assert not line.startswith("scenegen: verify: all")


def test_warnings_of_libraries_reach_nobody(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    def warn() -> dict[str, Any]:
        warnings.warn("settotalmass is deprecated", stacklevel=1)
        return {"ok": True}

    monkeypatch.setattr("scenegen.doctor.examine", warn)
    assert run(capfd, "doctor", "--json") == (0, '{"ok": true}\n', "")
