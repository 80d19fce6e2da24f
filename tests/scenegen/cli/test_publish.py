"""`scenegen publish` and hf:// as users meet them."""

import json

import pytest

from tests.command_line import run


@pytest.mark.usefixtures("verified", "undrawn")
def test_a_rehearsal_lists_what_would_go(standing, made, capsys):
    command = f"publish {made} --repo ada/pillars --dry-run"
    code, said, _ = run(capsys, f"{command} --workers 1")
    assert code == 0
    for name in ("train-*.worlds.zip", "README.md", "SHA256SUMS", "hf://ada/pillars@v1-"):
        assert name in said
    code, said, _ = run(capsys, f"{command} --json --tag v7")
    found = json.loads(said)
    assert (found["tag"], found["commit"], found["folder"]) == ("v7", None, "publish/pillars")
    for name, size in found["files"].items():
        assert (standing / "publish/pillars" / name).stat().st_size == size


def test_bad_use_ends_in_one_line(standing, made, hub, verified, capsys, monkeypatch):
    monkeypatch.delenv("HF_TOKEN")
    for words, ends, named in (
        (f"publish {made}", 2, "--repo"),
        (f"publish {made} --repo ada/pillars", 1, "no token for the Hub"),
        (f"publish {made} --repo ada/pillars --dry-run --licence mine", 1, "CC-BY-4.0"),
        ("inspect ada/pillars", 1, "ada/pillars: not a dataset"),
        ("inspect hf://ada/pillars", 1, "hf://ada/pillars: RepositoryNotFoundError"),
    ):
        code, said, error = run(capsys, words)
        assert (code, said) == (ends, ""), words
        assert named in error
        assert len(error.splitlines()) == 1, error
    assert not (standing / "publish").exists()
    assert not [line for line in hub.log if line.startswith(("POST", "PUT"))]
