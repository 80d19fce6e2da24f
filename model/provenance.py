"""Where a figure comes from: the commit and the versions that made it."""

import platform
import subprocess
from pathlib import Path

from scenegen.dataset.manifest import installed, software

PACKAGES = ("torch", "safetensors")


def commit() -> str:
    """The checkout's commit, with a + where it has changes; ``unknown`` outside of one, or in another project's."""
    here = Path(__file__).resolve().parents[1]
    if _git("rev-parse", "--show-toplevel") != str(here):
        return "unknown"
    return _git("describe", "--always", "--dirty=+", "--abbrev=12") or "unknown"


def _git(*words: str) -> str:
    try:
        here = Path(__file__).resolve().parent
        return subprocess.run(["git", *words], cwd=here, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:  # git is not installed
        return ""


def versions() -> dict[str, str]:
    """Versions of what a trained network depends on."""
    return software() | {"python": platform.python_version()} | {name: installed(name) for name in PACKAGES}
