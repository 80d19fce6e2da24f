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
    files = [place] if place.is_file() else sorted(place.rglob("*.py"))  # which follows no link into another part
    above = [pattern for _, pattern in list(ORDER.values())[list(ORDER).index(part) + 1 :]]
    files = [path for path in files if not any(one.is_symlink() for one in (path, *path.parents))]
    assert files
    wrong = {(str(path), name) for path in files for name in imported(path) for up in above if re.match(up, name)}
    assert wrong == set()


def test_nothing_is_imported_by_a_name_that_users_give_their_own_files() -> None:
    files = [
        path for folder in ("lidarsim", "scenegen", "model", "benchmarks") for path in (ROOT / folder).rglob("*.py")
    ]
    names = {name.split(".")[0] for path in files for name in imported(path)}
    assert not names & {"model", "cli", "tests", "docs", "benchmarks", "scenes", "utils", "train", "data"}


def test_the_top_level_holds_what_it_should_and_no_more() -> None:
    expected = {"cli.py", "lidarsim", "scenegen", "model", "scenes", "tests", "docs", "benchmarks", "pyproject.toml"}
    expected |= {"README.md", "LICENSE", "CHANGELOG.md"}
    tolerated = {"data", "runs", "bench", "publish", "dist", "build", "MUJOCO_LOG.TXT", "predictions.h5"}
    there = {path.name for path in ROOT.iterdir() if not path.name.startswith((".", "__")) and ".egg" not in path.name}
    assert there - tolerated == expected
