"""`kernel`: numba's njit, imported with the first call of a kernel, and with a cache that cannot go
stale.

Numba keys a cached kernel on its own file alone, so a kernel that calls one in another file would
go on running the old callee after an update. Here the cache lies in a folder named after numba's
version and the content of every file with kernels; a constant that a kernel uses must therefore
stand in such a file. The folder is made under the environment's SCENEGEN_CACHE, XDG_CACHE_HOME or
~/.cache, in that order, and used only where nobody but this user may write: numba unpickles what
lies there.
"""

import gc
import hashlib
import os
import stat
import sys
import threading
from collections.abc import Callable
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from typing import Any, TypeVar, cast

ROOT = 0
"""The system's own user."""
F = TypeVar("F", bound=Callable[..., Any])
_LOCK = threading.RLock()
"""Numba's settings are changed by one thread at a time."""


def kernel(function: F) -> F:
    """Compile `function` on first use; keep the machine code for later processes."""
    return cast(F, _Kernel(function))


class _Kernel:
    """A function that becomes numba's when it is first called, or when a kernel that calls it is
    compiled."""

    def __init__(self, function: Callable[..., Any]):
        update_wrapper(self, function)
        self.py_func = function

    def __call__(self, *arguments: Any) -> Any:
        return self.compiled(*arguments)

    @cached_property
    def compiled(self) -> Any:
        """Numba's dispatcher."""
        with _LOCK:
            return _compiled(self.py_func)

    @cached_property
    def callee(self) -> Any:
        """Numba's dispatcher for kernels that call this one: without the part by which Python
        would, unless that is there."""
        if "compiled" in self.__dict__:
            return self.compiled
        with _LOCK:
            return _compiled(self.py_func, no_cpython_wrapper=True)


def _compiled(function: Callable[..., Any], **options: bool) -> Any:
    """`function` as numba's dispatcher, which compiles it for each type of arguments that it
    meets."""
    numba = _numba()
    package = function.__module__.split(".")[0]
    # else compiled anew by every process: slower to start, but right
    kept = not cache_trouble(package)
    # numba does not look at options when it looks a kernel up: each has a folder of its own
    folder = cache_folder(package).joinpath(*options)
    previous, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
    try:
        return numba.njit(
            cache=kept, error_model="numpy", nogil=True, no_cfunc_wrapper=True, **options
        )(function)
    finally:
        numba.config.CACHE_DIR = previous


@cache
def _numba() -> Any:
    """Numba, which is told that a kernel called by another one stands for its dispatcher."""
    import numba
    from numba.core import event
    from numba.extending import typeof_impl

    class Uncollected(event.Listener):
        """Keeps the garbage collector off while kernels are compiled, which takes an eighth less
        time then. Numba's lock is held meanwhile."""

        depth = 0

        def on_start(self, event: Any) -> None:
            if self.depth == 0:
                self.collects = gc.isenabled()
                gc.disable()
            self.depth += 1

        def on_end(self, event: Any) -> None:
            self.depth -= 1
            if self.depth == 0 and self.collects:
                gc.enable()

    event.register("numba:compile", Uncollected())

    @typeof_impl.register(_Kernel)
    def dispatcher(value: _Kernel, context: Any) -> Any:
        return numba.types.Dispatcher(value.callee)

    return numba


@cache
def cache_folder(package: str) -> Path:
    """Where the kernels of `package`, as they stand on disk, are kept."""
    import numba

    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    roots = {Path(__file__).parent, Path(sys.modules[package].__file__ or __file__).parent}
    for path in sources(*roots):
        content = path.read_bytes()
        if b"lidarsim.jit" in content:
            digest.update(content)
    return cache_root() / "scenegen" / "kernels" / f"{package}-{digest.hexdigest()[:16]}"


def sources(*roots: Path) -> list[Path]:
    """Every Python file below `roots`, in order."""
    walks = (walk for root in roots for walk in os.walk(root, followlinks=True))
    return sorted(
        Path(folder, name) for folder, _, names in walks for name in names if name.endswith(".py")
    )


@cache
def cache_trouble(package: str) -> str:
    """Why the kernels of `package` cannot be kept; empty where they can, and the folder for them is
    made."""
    folder = cache_folder(package)
    if trouble := folder_trouble(folder):
        return trouble
    try:
        foreign = next((item for item in folder.rglob("*") if not is_ours(item.lstat())), None)
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    if foreign is not None:
        return f"{foreign} belongs to another user"
    return "" if os.access(folder, os.W_OK) else f"no permission to write to {folder}"


def no_kernels(package: str) -> bool:
    """Whether none of the kernels of `package` is kept yet."""
    return not any(cache_folder(package).rglob("*.nbc"))


def is_ours(found: os.stat_result) -> bool:
    """Whether a file belongs to this user or to root."""
    return found.st_uid in (os.geteuid(), ROOT)


def folder_trouble(folder: Path) -> str:
    """Why what lies in a `folder` of the cache cannot be trusted; empty where it can, and the
    folder is made.

    The cache's root and every folder from there on must be this user's or root's. Nobody else may
    write to them, but to a root such as /tmp, where each may move only what is his.
    """
    root = cache_root()
    try:
        for level in reversed([folder, *folder.parents]):
            if not level.exists():
                level.mkdir(mode=0o700, exist_ok=True)
            if not level.is_relative_to(root):
                continue
            found = level.lstat()
            if not stat.S_ISDIR(found.st_mode):
                return f"{level} is no folder"
            if not is_ours(found):
                return f"{level} belongs to another user"
            if found.st_mode & 0o022 and not (level == root and found.st_mode & stat.S_ISVTX):
                return f"others may write to {level} (chmod go-w)"
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    return ""


def cache_root() -> Path:
    """Where all that may be made again is kept: $SCENEGEN_CACHE, or the user's cache."""
    own, users = os.environ.get("SCENEGEN_CACHE"), os.environ.get("XDG_CACHE_HOME", "")
    if own:
        return Path(own).resolve()
    if Path(users).is_absolute():  # a relative one is void, as its specification has it
        return Path(users).resolve()
    home = Path(os.path.expanduser("~"))  # noqa: PTH111 (Path's raises where there is no home)
    return Path(home if home.is_absolute() else os.devnull, ".cache").resolve()
