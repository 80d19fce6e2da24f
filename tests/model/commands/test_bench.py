"""`scenegen bench` as users meet it."""

import json
import shutil

import pytest

from tests.command_line import SMALL, refused, run


@pytest.fixture
def here(once, tmp_path, monkeypatch, capsys):
    """A folder with a small dataset under data/, to stand in."""

    def generate(folder):
        (folder / "small.toml").write_text(SMALL)
        words = (
            "--recipe",
            folder / "small.toml",
            "--n",
            6,
            "--workers",
            1,
            "--quiet",
            "--out",
            folder / "data" / "pillar",
        )
        assert run(capsys, "generate", *words)[0] == 0

    monkeypatch.chdir(tmp_path)
    shutil.copytree(once("here", generate), tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_without_arguments_it_takes_what_is_under_data(here, capsys):
    code, said, _ = run(capsys, "bench --quick --workers 1")
    assert code == 0
    assert "pillar, reconstruction" in said
    assert "pillar, planning" in said
    report = json.loads((here / "bench" / "report.json").read_text())
    assert report["command"] == "scenegen bench --quick --workers 1"
    assert report["reconstruction"]["pillar"]["truth"]["iou"]["mean"] == 1.0
    assert (here / "bench" / "report.md").read_text().startswith("# Bench")
    code, said, _ = run(capsys, "bench --method returns --quick --workers 1 --json -o other")
    assert (code, json.loads(said)) == (0, json.loads((here / "other" / "report.json").read_text()))


def test_bad_use_ends_in_one_line(here, capsys, monkeypatch):
    for words, named in (
        (("data/pillar", "--method", "extrud"), "did you mean 'extrude'?"),
        (("data/pillar", "data/pillar"), "two datasets of one kind"),
        (("data/pillar", "--split", "all"), "--split"),
    ):
        assert named in refused(capsys, "bench", *words, "--quiet")
    monkeypatch.chdir(here / "data" / "pillar")
    ended, _, error = run(capsys, "bench --quiet")
    assert ended == 2
    assert "none under data/" in error
