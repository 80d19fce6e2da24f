"""`kernel`: numba's njit, imported with the first call of a kernel, and with a cache that is never
stale.

Numba keys a cached kernel on its own file alone, so a kernel that calls one in another file would
go on running the old callee after an update. Here the cache lies in a folder named after numba's
version and the content of every file with kernels; a constant that a kernel uses must therefore
stand in such a file. The folder is made under the environment's SCENEGEN_CACHE, XDG_CACHE_HOME or
~/.cache, in that order. It is used only if no other user may write to it: numba unpickles the files
in it."""

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
"""Held while numba's settings, which all threads share, are changed."""


def kernel(function: F) -> F:
    """Compile `function` on first use; keep the machine code for later processes."""
    return cast(F, _Kernel(function))


class _Kernel:
    """A function that numba compiles on its first call, or with the first kernel that calls it."""

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
        """Numba's dispatcher for kernels that call this one.

        It lacks the wrapper for calls from Python, which takes time to compile, unless that exists
        already."""
        if "compiled" in self.__dict__:
            return self.compiled
        with _LOCK:
            return _compiled(self.py_func, no_cpython_wrapper=True)


def _compiled(function: Callable[..., Any], **options: bool) -> Any:
    """Make numba's dispatcher of `function`, which compiles it for each combination of types."""
    numba = _numba()
    package = function.__module__.split(".")[0]
    # without a folder that can be trusted, every process compiles anew
    cached = not cache_trouble(package)
    # numba does not look at options when it looks a kernel up: each has a folder of its own
    folder = cache_folder(package).joinpath(*options)
    # numba reads the folder when the dispatcher is made, and from nowhere else
    previous, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(folder)
    try:
        return numba.njit(
            cache=cached, error_model="numpy", nogil=True, no_cfunc_wrapper=True, **options
        )(function)
    finally:
        numba.config.CACHE_DIR = previous


@cache
def _numba() -> Any:
    """Import numba, and register that it types a `_Kernel` in another kernel's body as its
    dispatcher."""
    import numba
    from numba.core import event
    from numba.extending import typeof_impl

    class Uncollected(event.Listener):
        """Turns the garbage collector off during compilation, which then takes an eighth less time.

        Numba holds its lock meanwhile."""

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

    # compilation makes many objects, none of which are garbage until it ends
    event.register("numba:compile", Uncollected())

    @typeof_impl.register(_Kernel)
    def _dispatcher(value: _Kernel, context: Any) -> Any:
        return numba.types.Dispatcher(value.callee)

    return numba


@cache
def cache_folder(package: str) -> Path:
    """Return the folder for the kernels of `package` as its files are now."""
    import numba

    digest = hashlib.sha256(f"{numba.__version__} {sys.version_info[:2]}".encode())
    roots = {Path(__file__).parent, Path(sys.modules[package].__file__ or __file__).parent}
    for path in sources(*roots):
        content = path.read_bytes()
        # only files with kernels count: others change more often, and change no machine code
        if b"lidarsim.jit" in content:
            digest.update(content)
    return cache_root() / "scenegen" / "kernels" / f"{package}-{digest.hexdigest()[:16]}"


def sources(*roots: Path) -> list[Path]:
    """List every Python file below `roots`, sorted."""
    walks = (walk for root in roots for walk in os.walk(root, followlinks=True))
    return sorted(
        Path(folder, name) for folder, _, names in walks for name in names if name.endswith(".py")
    )


@cache
def cache_trouble(package: str) -> str:
    """Explain why the kernels of `package` cannot be cached; "" if they can, and their folder
    exists."""
    folder = cache_folder(package)
    if trouble := folder_trouble(folder):
        return trouble
    try:
        # numba unpickles these files, which runs code of whoever wrote them
        foreign = next((item for item in folder.rglob("*") if not is_ours(item.lstat())), None)
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    if foreign is not None:
        return f"{foreign} belongs to another user"
    return "" if os.access(folder, os.W_OK) else f"no permission to write to {folder}"


def no_kernels(package: str) -> bool:
    """Return whether no kernel of `package` is cached yet."""
    return not any(cache_folder(package).rglob("*.nbc"))


def is_ours(status: os.stat_result) -> bool:
    """Return whether a file belongs to this user or to root."""
    return status.st_uid in (os.geteuid(), ROOT)


def folder_trouble(folder: Path) -> str:
    """Explain why a cache `folder` cannot be trusted; "" if it can, and it exists.

    The cache's root and every folder from there on must belong to this user or root, and nobody
    else may write to them. A root with the sticky bit, such as /tmp, may be writable: users can
    move only their own files in it."""
    root = cache_root()
    try:
        # from the outermost: a folder can be swapped by whoever may write to one around it
        for level in reversed([folder, *folder.parents]):
            if not level.exists():
                level.mkdir(mode=0o700, exist_ok=True)
            if not level.is_relative_to(root):
                continue
            status = level.lstat()
            if not stat.S_ISDIR(status.st_mode):
                return f"{level} is no folder"
            if not is_ours(status):
                return f"{level} belongs to another user"
            if status.st_mode & 0o022 and not (level == root and status.st_mode & stat.S_ISVTX):
                return f"others may write to {level} (chmod go-w)"
    except OSError as error:
        return f"{error.filename}: {error.strerror}"
    return ""


def cache_root() -> Path:
    """Return the folder for everything that can be made again: $SCENEGEN_CACHE, or the user's
    cache."""
    chosen, xdg = os.environ.get("SCENEGEN_CACHE"), os.environ.get("XDG_CACHE_HOME", "")
    if chosen:
        return Path(chosen).resolve()
    if Path(xdg).is_absolute():  # a relative one is void, as its specification has it
        return Path(xdg).resolve()
    home = Path(os.path.expanduser("~"))  # noqa: PTH111 (Path's raises where there is no home)
    return Path(home if home.is_absolute() else os.devnull, ".cache").resolve()
