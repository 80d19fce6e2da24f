"""`scenegen bench` as users meet it."""

import json
import shutil

import pytest

from tests.command_line import done
from tests.conftest import dataset_in


@pytest.fixture
def here(once, tmp_path, monkeypatch, undrawn):
    """A folder with a small dataset under data/, to stand in."""

    def generate(folder):
        dataset_in(folder / "data" / "pillar", counts={"train": 6, "val": 3, "test": 3})

    monkeypatch.chdir(tmp_path)
    shutil.copytree(once("here", generate), tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_without_arguments_it_takes_what_is_under_data(here, capsys):
    assert "pillar, planning" in done(capsys, "bench --quick --workers 1")
    report = json.loads((here / "bench" / "report.json").read_text())
    assert report["command"] == "scenegen bench --quick --workers 1"
    assert report["reconstruction"]["pillar"]["truth"]["iou"]["mean"] == 1.0
    assert (here / "bench" / "report.md").exists()
    said = done(capsys, "bench --method returns --quick --workers 1 --json -o other")
    assert json.loads(said) == json.loads((here / "other" / "report.json").read_text())
