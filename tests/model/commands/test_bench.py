"""`scenegen bench` as users meet it."""

import json
import shutil

import pytest

from tests.command_line import refused, run
from tests.conftest import dataset_in


@pytest.fixture
def here(once, tmp_path, monkeypatch):
    """A folder with a small dataset under data/, to stand in."""

    def generate(folder):
        dataset_in(folder / "data" / "pillar", counts={"train": 6, "val": 3, "test": 3})

    monkeypatch.chdir(tmp_path)
    shutil.copytree(once("here", generate), tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_without_arguments_it_takes_what_is_under_data(here, capsys):
    code, said, _ = run(capsys, "bench --quick --workers 1")
    assert code == 0
    assert "pillar, planning" in said
    report = json.loads((here / "bench" / "report.json").read_text())
    assert report["command"] == "scenegen bench --quick --workers 1"
    assert report["reconstruction"]["pillar"]["truth"]["iou"]["mean"] == 1.0
    assert (here / "bench" / "report.md").exists()
    code, said, _ = run(capsys, "bench --method returns --quick --workers 1 --json -o other")
    assert (code, json.loads(said)) == (0, json.loads((here / "other" / "report.json").read_text()))


def test_bad_use_ends_in_one_line(here, capsys, monkeypatch):
    for words, named in (
        (("data/pillar", "--method", "extrud"), "did you mean 'extrude'?"),
        (("data/pillar", "data/pillar"), "two datasets of one kind"),
    ):
        assert named in refused(capsys, "bench", *words, "--quiet")
    monkeypatch.chdir(here / "data" / "pillar")
    assert "none under data/" in run(capsys, "bench --quiet")[2]
