"""Imports run one way: the command, the model, scenegen, lidarsim."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ORDER = {
    "lidarsim": (ROOT / "lidarsim", r"lidarsim\b"),
    "scenegen": (ROOT / "scenegen", r"scenegen\b(?!\.(model|__main__)\b)"),
    "model": (ROOT / "model", r"scenegen\.model\b"),
    "cli": (ROOT / "cli.py", r"(cli|scenegen\.__main__)\b"),
}
"""Every part, the lowest first: where it is, and how it is imported."""


def imported(path: Path) -> set[str]:
    """Names of modules that a file imports, at any depth."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {str(node.module)} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


@pytest.mark.parametrize("part", ORDER)
def test_a_part_imports_none_above_it(part: str) -> None:
    place, _ = ORDER[part]
    files = (
        [place] if place.is_file() else sorted(place.rglob("*.py"))
    )  # which follows no link into another part
    above = [pattern for _, pattern in list(ORDER.values())[list(ORDER).index(part) + 1 :]]
    files = [path for path in files if not any(one.is_symlink() for one in (path, *path.parents))]
    assert files
    wrong = {
        (str(path), name)
        for path in files
        for name in imported(path)
        for up in above
        if re.match(up, name)
    }
    assert wrong == set()


def rooms_of(part: str) -> dict[str, set[str]]:
    """Every room of a package, a file or a folder at its top, with the rooms that it imports."""
    place = ORDER[part][0]
    prefix = "scenegen.model." if part == "model" else f"{part}."
    rooms = {
        path.stem: path
        for path in place.iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    found: dict[str, set[str]] = {}
    for name, path in rooms.items():
        if name in ("__init__", "__main__") or path.is_symlink():
            continue
        files = [path] if path.is_file() else sorted(path.rglob("*.py"))
        named = {
            one.removeprefix(prefix).split(".")[0]
            for f in files
            for one in imported(f)
            if one.startswith(prefix)
        }
        found[name] = named & rooms.keys() - {name}
    return found


@pytest.mark.parametrize("part", ["lidarsim", "scenegen", "model"])
def test_inside_a_part_no_room_imports_one_that_imports_it(part: str) -> None:
    """Taking away, again and again, the rooms that import none of those left takes away all of
    them."""
    left = rooms_of(part)
    assert len(left) > 5
    while lowest := {name for name, below in left.items() if not below & left.keys()}:
        left = {name: below for name, below in left.items() if name not in lowest}
    assert left == {}


def test_nothing_is_imported_by_a_name_that_users_give_their_own_files() -> None:
    files = [
        path
        for folder in ("lidarsim", "scenegen", "model", "benchmarks")
        for path in (ROOT / folder).rglob("*.py")
    ]
    names = {name.split(".")[0] for path in files for name in imported(path)}
    assert not names & {
        "model",
        "cli",
        "tests",
        "docs",
        "benchmarks",
        "scenes",
        "utils",
        "train",
        "data",
    }


def test_the_top_level_holds_what_it_should_and_no_more() -> None:
    expected = {
        "cli.py",
        "lidarsim",
        "scenegen",
        "model",
        "scenes",
        "tests",
        "docs",
        "benchmarks",
        "pyproject.toml",
    }
    expected |= {"README.md", "LICENSE", "CHANGELOG.md", "mkdocs.yml"}
    tolerated = {
        "data",
        "runs",
        "bench",
        "publish",
        "dist",
        "build",
        "MUJOCO_LOG.TXT",
        "predictions.h5",
    }
    there = {
        path.name
        for path in ROOT.iterdir()
        if not path.name.startswith((".", "__")) and ".egg" not in path.name
    }
    assert there - tolerated == expected
