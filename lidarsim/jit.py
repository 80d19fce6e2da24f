"""`kernel`: numba's njit with a cache that cannot go stale.

Numba keys a cached kernel on its own file alone, so a kernel that calls one in another file would go on running the
old callee after an update. Here the cache lies in a folder named after numba's version and the content of every file
with kernels; a constant that a kernel uses must therefore stand in such a file. The folder is made under the
environment's SCENEGEN_CACHE, XDG_CACHE_HOME or ~/.cache, in that order.
"""

import hashlib
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` on first use; keep the machine code for later processes."""
    folder = cache_folder(function.__module__.split(".")[0])
    try:
        folder.mkdir(parents=True, exist_ok=True)
        kept = os.access(folder, os.W_OK)
    except OSError:
        kept = False  # compiled anew by every process: slower to start, but right
    previous, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
    try:
        return numba.njit(cache=kept, nogil=True, error_model="numpy")(function)
    finally:
        numba.config.CACHE_DIR = previous


@cache
def cache_folder(package: str) -> Path:
    """Where the kernels of `package`, as they stand on disk, are kept."""
    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    roots = {Path(__file__).parent, Path(sys.modules[package].__file__ or __file__).parent}
    for path in sorted(path for root in roots for path in root.rglob("*.py")):
        content = path.read_bytes()
        if b"lidarsim.jit" in content:
            digest.update(content)
    base = os.environ.get("SCENEGEN_CACHE") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "scenegen" / "kernels" / f"{package}-{digest.hexdigest()[:16]}"
