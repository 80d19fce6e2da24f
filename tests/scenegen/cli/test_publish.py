"""`scenegen publish` and hf:// as users meet them."""

import json

import pytest

from tests.command_line import run
from tests.refusals import refuses_command
from tests.scenegen import cases


@pytest.mark.usefixtures("verified", "undrawn")
def test_a_rehearsal_lists_what_would_go(standing, made, capsys):
    command = f"publish {made} --repo ada/pillars --dry-run"
    code, said, notes = run(capsys, f"{command} --workers 1")
    assert code == 0
    assert "Wrote publish/pillars. Nothing is uploaded (--dry-run)." in notes
    for name in ("train-*.worlds.zip", "README.md", "SHA256SUMS", "hf://ada/pillars@v2-"):
        assert name in said
    staged = json.loads(run(capsys, f"{command} --json --tag v7")[1])
    sizes = {name: (standing / "publish/pillars" / name).stat().st_size for name in staged["files"]}
    assert staged["files"] == sizes
    named = [staged[name] for name in ("tag", "commit", "folder")]
    assert named == ["v7", None, "publish/pillars"]


def test_bad_use_ends_in_one_line(standing, made, hub, verified, capsys, monkeypatch):
    monkeypatch.delenv("HF_TOKEN")
    for (words,) in cases("cli/publish"):
        refuses_command(capsys, words.replace("MADE", str(made)), words)
    assert not (standing / "publish").exists()
    assert not [line for line in hub.log if line.startswith(("POST", "PUT"))]
