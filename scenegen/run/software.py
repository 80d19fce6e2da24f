"""What this process computes with: versions of all that the numbers depend on, and a digest of its
source."""

import hashlib
import platform
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
