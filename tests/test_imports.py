"""Rooms stand on floors: each imports only lower ones, for types and inside functions too; and no
files go in a circle."""

import ast
import importlib
import re
import subprocess
from functools import cache
from graphlib import TopologicalSorter

import pytest

import lidarsim
import scenegen
from tests.command_line import ROOT
from tests.refusals import refuses

FLOORS = 9
FACES = ("scenegen", "cli")
"""What offers or starts things of any room."""


@cache
def modules():
    """Paths of all product modules by the names under which they are imported; `scenegen/model` may
    be a link to `model`."""
    found = {"cli": ROOT / "cli.py"}
    for package in ("lidarsim", "scenegen", "model"):
        for path in (ROOT / package).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            if parts[:2] != ("scenegen", "model"):
                name = ".".join(("scenegen", *parts) if package == "model" else parts)
                found[name.removesuffix(".__init__")] = path
    return found


@cache
def imported(path):
    """Names that a file imports, at any depth."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def module_of(name):
    """The product module that holds a name, if any."""
    while name and name not in modules():
        name = name.rpartition(".")[0]
    return name


@cache
def below():
    """Every module with those that it imports; the faces of packages are looked through."""
    return {
        name: {
            other
            for other in map(module_of, imported(path))
            if other and other != name and modules()[other].name != "__init__.py"
        }
        for name, path in modules().items()
    }


def room_of(name):
    """`lidarsim`, a folder of `scenegen`, or a face."""
    room = ".".join(name.split(".")[: 2 if name.startswith("scenegen") else 1])
    return "scenegen.cli" if room == "scenegen.__main__" else room


@cache
def rooms():
    """Every room with those that it imports."""
    found = {}
    for name, others in below().items():
        room = room_of(name)
        found.setdefault(room, set()).update({*map(room_of, others)} - {room})
    return found


def test_no_files_import_each_other():
    assert len([*TopologicalSorter(below()).static_order()]) > 100


def test_a_room_imports_only_lower_ones():
    assert len(rooms()) > 12
    waiting, floors = TopologicalSorter(rooms()), []
    waiting.prepare()  # refuses circles
    while waiting.is_active():
        floors.append(set(waiting.get_ready()))
        waiting.done(*floors[-1])
    assert floors[0] == {"lidarsim"}
    assert len(floors) <= FLOORS


@pytest.mark.parametrize("above", ["scenegen.model", "scenegen.cli"])
def test_the_library_imports_neither_the_model_nor_the_command_line(above):
    users = {room for room, others in rooms().items() if above in others}
    assert users <= {*FACES, "scenegen.cli"}


@pytest.mark.parametrize("package", [lidarsim, scenegen])
def test_a_package_offers_names_that_no_module_takes(package):
    """Once it is imported, a module is an attribute of its package."""
    offered = set(package.__all__)
    assert offered <= set(dir(package))
    assert all(getattr(package, name).__doc__ for name in offered)
    assert not {f"{package.__name__}.{name}" for name in offered} & {*modules(), *rooms()}
    refuses(package.__name__, getattr, package, "absent", error=AttributeError)


def test_every_place_that_stands_in_text_is_there():
    """As `module:Object`, in registries and tables."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in modules().values())
    places = set(re.findall(r'"((?:lidarsim|scenegen)\.[\w.]+):(\w+)"', text))
    assert len(places) > 50
    wrong = {place for place in places if not hasattr(importlib.import_module(place[0]), place[1])}
    assert wrong == set()


TOP = """
benchmarks cli.py docs lidarsim model scenegen scenes tests pyproject.toml README.md LICENSE
CHANGELOG.md CITATION.cff CONTRIBUTING.md mkdocs.yml
"""


@pytest.mark.checkout
def test_the_top_level_holds_what_it_should_and_no_more():
    words = ["git", "-C", str(ROOT), "ls-files", ":(glob)*", ":(glob)*/**"]
    there = {name.partition("/")[0] for name in subprocess.check_output(words, text=True).split()}
    assert {name for name in there if name[0] != "."} == set(TOP.split())
