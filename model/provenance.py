"""Where a figure comes from: the commit and the versions that made it."""

import platform
import subprocess
from pathlib import Path

from scenegen.dataset.manifest import installed, software

PACKAGES = ("torch", "safetensors")


def commit() -> str:
    """The checkout's commit, with a + where it has changes; ``unknown`` outside of one."""
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty=+", "--abbrev=12"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    return described.stdout.strip() or "unknown"


def versions() -> dict[str, str]:
    """Versions of what a trained network depends on."""
    return software() | {"python": platform.python_version()} | {name: installed(name) for name in PACKAGES}
