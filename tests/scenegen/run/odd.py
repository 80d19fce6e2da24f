"""A node that is not as the others, for tests on real engines."""

import shutil
from pathlib import Path

from tests.command_line import ROOT

NODES = {
    "": r"another scenegen there than here: source \w+, not \w+; .* \(on ",
    "scenegen": r"no task can be done: No module named 'scenegen'; .* \(on ",
}
"""By what a node lacks, "" for one of another version: what is said of it."""
CUSTOM = """
import os, sys
from importlib.machinery import PathFinder

class Odd:
    def find_spec(name, path=None, target=None):
        if name == {lacks!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
        return PathFinder.find_spec(name, [{here!r}]) if name in ("lidarsim", "scenegen") else None

if os.environ.get("SLURMD_NODENAME") == "node1":
    sys.meta_path.insert(0, Odd)
"""


def odd_node(folder: Path, lacks: str) -> None:
    """Have Python be so on Slurm's node1, where `folder` is the first of the environment's
    PYTHONPATH."""
    for package in ("lidarsim", "scenegen"):
        shutil.copytree(ROOT / package, folder / "theirs" / package)
    (folder / "theirs" / "scenegen" / "other.py").write_text("# is not in this one")
    (folder / "sitecustomize.py").write_text(
        CUSTOM.format(lacks=lacks, here=str(folder / "theirs"))
    )
