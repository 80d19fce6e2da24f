"""Imports run one way: the command, the model, scenegen, lidarsim; and in no circle of files."""

import ast
import re
import subprocess
from functools import cache

import pytest

import lidarsim
import scenegen
from tests.command_line import ROOT

ORDER = {
    "lidarsim": (ROOT / "lidarsim", r"lidarsim\b"),
    "scenegen": (ROOT / "scenegen", r"scenegen\b(?!\.(model|__main__)\b)"),
    "model": (ROOT / "model", r"scenegen\.model\b"),
    "command": (ROOT / "scenegen" / "__main__.py", r"(cli|scenegen\.__main__)\b"),
}
"""Every part, the lowest first: where it is, and how it is imported."""
NAMES = {"lidarsim": "lidarsim", "scenegen": "scenegen", "model": "scenegen.model"}
"""The parts that are packages, by the names under which they are imported."""
API = ROOT / "scenegen" / "__init__.py"
"""The one file that names what stands above it: what it offers is looked up when asked for."""


def files_of(part):
    """Its files, less those of another part that stand in it; a link leads into another part."""
    place, _ = ORDER[part]
    found = [place] if place.is_file() else sorted(place.rglob("*.py"))
    others = {other for name, (other, _) in ORDER.items() if name != part and other.is_file()}
    return [
        path
        for path in found
        if path not in others and not any(one.is_symlink() for one in (path, *path.parents))
    ]


@cache
def imported(path):
    """Names of modules that a file imports, at any depth, and whether for types alone."""
    found = {}
    waiting = [(ast.parse(path.read_text(encoding="utf-8")), False)]
    for node, typing in waiting:
        names = set()
        if isinstance(node, ast.Import):
            names = {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = {str(node.module)} | {f"{node.module}.{alias.name}" for alias in node.names}
        found |= {name: typing and found.get(name, True) for name in names}
        inner = typing or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
        children = ast.iter_child_nodes(node)  # no expression imports
        waiting += [(one, inner) for one in children if not isinstance(one, ast.expr)]
    return found


def circles(below):
    """The sets of names that all lead to each other."""
    reached = {}
    for name in below:
        found, waiting = set(), [name]
        while waiting:
            further = (below[waiting.pop()] & below.keys()) - found
            found |= further
            waiting += further
        reached[name] = found - {name}
    return {
        frozenset({name} | {other for other in found if name in reached[other]})
        for name, found in reached.items()
        if any(name in reached[other] for other in found)
    }


def test_a_part_imports_none_above_it():
    patterns = [pattern for _, pattern in ORDER.values()]
    wrong = {
        (str(path), name)
        for number, part in enumerate(ORDER, start=1)
        for path in files_of(part)
        for name in imported(path)
        if path != API and any(re.match(above, name) for above in patterns[number:])
    }
    assert wrong == set()


def test_the_library_does_not_import_the_command_line():
    """Only commands take options and print; they give the library callbacks, not the reverse."""
    commands = ("cli", "commands")
    wrong = {
        (str(path), name)
        for part in NAMES
        for path in files_of(part)
        if path.relative_to(ORDER[part][0]).parts[0] not in commands
        for name in imported(path)
        if re.match(r"scenegen\.(cli|model\.commands)\b", name)
    }
    assert wrong == set()


def rooms_of(part):
    """Every room of a package, a file or a folder at its top, with the rooms that it imports."""
    place, prefix = ORDER[part][0], f"{NAMES[part]}."
    found = {}
    for path in files_of(part):
        room = path.relative_to(place).parts[0].removesuffix(".py")
        if room != "__init__":
            names = (one for one in imported(path) if one.startswith(prefix))
            found.setdefault(room, set()).update(
                one.removeprefix(prefix).split(".")[0] for one in names
            )
    return found


@pytest.mark.parametrize("part", NAMES)
def test_inside_a_part_no_room_imports_one_that_imports_it(part):
    rooms = rooms_of(part)
    assert len(rooms) > 5
    assert circles(rooms) == set()


def test_no_file_imports_one_that_imports_it():
    """Types alone may go in a circle: they are imported by nobody who runs the file."""
    names = {}
    for part, name in NAMES.items():
        for path in files_of(part):
            inner = path.relative_to(ORDER[part][0]).with_suffix("").parts
            names[".".join([name, *inner]).removesuffix(".__init__")] = path
    below = {
        name: {one for one, typing in imported(path).items() if one in names and not typing}
        for name, path in names.items()
    }
    assert len(below) > 100
    assert circles(below) == set()


def test_the_package_offers_names_that_no_room_takes():
    offered = set(scenegen.__all__)
    assert offered <= set(dir(scenegen))
    for name in offered:
        assert getattr(scenegen, name).__doc__, name
    assert not offered & rooms_of("scenegen").keys()
    with pytest.raises(AttributeError, match="absent"):
        scenegen.absent  # noqa: B018


def test_nothing_is_imported_by_a_name_that_users_give_their_own_files():
    files = [path for part in ORDER for path in files_of(part)]
    names = {name.split(".")[0] for path in files for name in imported(path)}
    assert not names & {"model", "cli", "tests", "docs", "benchmarks", "scenes", "utils", "train"}


@pytest.mark.checkout
def test_the_top_level_holds_what_it_should_and_no_more():
    words = ["git", "-C", str(ROOT), "ls-files", ":(glob)*", ":(glob)*/**"]
    there = {name.partition("/")[0] for name in subprocess.check_output(words, text=True).split()}
    expected = (
        "benchmarks cli.py docs lidarsim model scenegen scenes tests pyproject.toml README.md"
    )
    expected += " LICENSE CHANGELOG.md CITATION.cff CONTRIBUTING.md mkdocs.yml"
    assert {name for name in there if name[0] != "."} == set(expected.split())


def test_no_module_takes_the_place_of_a_name_that_is_offered():
    """Once it is imported, a module is an attribute of its package."""
    for package in (lidarsim, scenegen):
        assert not rooms_of(package.__name__).keys() & {*package.__all__}
