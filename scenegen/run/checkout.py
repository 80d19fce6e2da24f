"""The checkout that this code runs from, by which a figure's origin is told."""

import subprocess
from pathlib import Path


def commit() -> str:
    """The checkout's commit, with a + where it has changes; ``unknown`` outside of one, or in
    another project's."""
    here = Path(__file__).resolve().parents[1]
    if _git("rev-parse", "--show-toplevel") != str(here):
        return "unknown"
    return _git("describe", "--always", "--dirty=+", "--abbrev=12") or "unknown"


def _git(*words: str) -> str:
    try:
        here = Path(__file__).resolve().parent
        return subprocess.run(
            ["git", *words], cwd=here, capture_output=True, text=True, check=False
        ).stdout.strip()
    except OSError:  # git is not installed
        return ""
