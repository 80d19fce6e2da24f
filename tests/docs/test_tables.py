"""The tables of parameters in the docs are those of the dataclasses; no table is wider than it can
be read."""

import runpy
from types import SimpleNamespace

import pytest

from scenegen.worlds.kinds import kind_names
from tests.command_line import ROOT, page

PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "scenes").glob("*.md")),
]

tables = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "tables.py")))


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_the_tables_of_parameters_are_those_of_the_code(path):
    text = path.read_text()
    assert text.count("<!-- parameters of") == len(tables.ASKED.findall(text))
    assert tables.filled(text) == text, "run python docs/tables.py"


def test_the_settings_have_every_table():
    kinds = " ".join(map(str.capitalize, kind_names()))
    recipe = "FlightConfig Acceptance Lidar GridSpec NoiseConfig Mapper Known"
    others = "TrainConfig NetworkConfig LossConfig BenchConfig Thresholds PlanConfig Vehicle Rules"
    names = f"{kinds} {recipe} {others} Survey Cruise Fusing Traffic".split()
    assert {one for _, _, one, _ in tables.ASKED.findall(page("settings.md"))} == set(names)
    assert "<!-- stages -->" in page("settings.md")
