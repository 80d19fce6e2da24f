"""Imports run one way: cli, model, scenegen, lidarsim."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ORDER = ("lidarsim", "scenegen", "model", "cli")


def imported(path: Path) -> set[str]:
    """Top-level names that a file imports, at any depth."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add(str(node.module).split(".")[0])
    return found


@pytest.mark.parametrize("package", ORDER)
def test_a_package_imports_none_above_it(package: str) -> None:
    files = [ROOT / f"{package}.py"] if package == "cli" else sorted((ROOT / package).rglob("*.py"))
    above = set(ORDER[ORDER.index(package) + 1 :])
    assert files
    assert {path: imported(path) & above for path in files if imported(path) & above} == {}


def test_the_top_level_holds_what_it_should_and_no_more() -> None:
    expected = {"cli.py", "lidarsim", "scenegen", "model", "scenes", "tests", "docs", "benchmarks", "pyproject.toml"}
    expected |= {"README.md", "LICENSE", "CHANGELOG.md"}
    tolerated = {"data", "runs", "bench", "publish", "dist", "build", "MUJOCO_LOG.TXT", "predictions.h5"}
    there = {path.name for path in ROOT.iterdir() if not path.name.startswith((".", "__")) and ".egg" not in path.name}
    assert there - tolerated == expected
