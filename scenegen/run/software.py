"""What this process computes with: versions, a digest of the sources, and the commit of the
checkout."""

import hashlib
import platform
import subprocess
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import lidarsim
import scenegen
from lidarsim.jit import sources

PACKAGES = ("mujoco", "ompl", "numpy", "numba", "trimesh")
"""What the numbers depend on besides scenegen itself."""


def software() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    found = {"scenegen": scenegen.__version__, "machine": platform.machine()}
    return found | {package: installed(package) for package in PACKAGES}


def processor() -> str:
    """What this machine's processor is called."""
    with suppress(OSError):  # elsewhere than on Linux
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "CPU"


@cache
def installed(package: str) -> str:
    """The installed version of a package, or ``absent``."""
    from importlib.metadata import (
        PackageNotFoundError,
        version,
    )  # which takes longer than reading a manifest

    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


@cache
def identity() -> dict[str, Any]:
    """What two machines must have in common whose tasks become one result: `software`, the
    generator, and a digest of every Python file of both packages. Worked out once a process."""
    digest = hashlib.sha256()
    for path in sources(*(Path(str(package.__file__)).parent for package in (lidarsim, scenegen))):
        digest.update(path.read_bytes())
    return software() | {"generator": scenegen.GENERATOR, "source": digest.hexdigest()[:12]}


def commit() -> str:
    """The checkout's commit, with a + where it has changes; ``unknown`` outside of one, or in
    another project's."""
    here = Path(__file__).resolve().parents[2]
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
