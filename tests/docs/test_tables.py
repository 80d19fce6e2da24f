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


def test_pages_list_every_table_of_a_recipe():
    kinds = " ".join(map(str.capitalize, kind_names()))
    others = "Flight Acceptance Lidar GridSpec Faults Mapper"
    for name, names in (("recipes.md", others), ("kinds.md", kinds)):
        assert {one for _, _, one, _ in tables.ASKED.findall(page(name))} == set(names.split())
