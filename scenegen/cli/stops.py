"""Stops from outside (Ctrl-C, SIGTERM, SIGHUP) at any moment: what is begun is undone, one line,
and the end.

No exception is raised, which a library's callback could swallow or print; the process ends within
the signal's handler. Nothing is imported here that takes long, so that a command can begin with
this.
"""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from scenegen.base.executors import undo_all

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
STOPPED = "stopped; nothing finished is lost: give the same command again"
CODE = 130
MOST_UNDOING_S = 20
"""After which a process that cannot undo what it began is ended by the system, seconds."""

_owner = 0
_noted: list[list[int]] = []


def is_command() -> bool:
    """Whether this process was begun to be the command line, and not to import it."""
    name = os.path.basename(sys.argv[0])  # noqa: PTH119 (pathlib takes time)
    return name in ("scenegen", "scenegen-lidar", "cli.py")


def answer() -> None:
    """From here on, let a stop end this process."""
    global _owner
    _owner = os.getpid()
    for number in STOPS:
        signal.signal(number, _stop)


def answer_hanging() -> None:
    """Let a second stop end this process even if it hangs in a library, where Python cannot answer
    the first.

    The kernel then forgets the handler when it has called it once, which is where Python only notes
    the signal.
    """
    import ctypes

    library = ctypes.CDLL(None)
    library.sysv_signal.argtypes = (ctypes.c_int, ctypes.c_void_p)
    for number in STOPS:
        action = ctypes.create_string_buffer(256)  # begins with the handler
        library.sigaction(int(number), None, action)
        library.sysv_signal(int(number), ctypes.c_void_p.from_buffer(action))


@contextmanager
def noted() -> Iterator[Callable[[], bool]]:
    """For a loop that looks whether to stop: a first stop is noted, and makes what is given true; a
    second ends all."""
    asked: list[int] = []
    _noted.append(asked)
    try:
        yield lambda: bool(asked)
    finally:
        _noted.remove(asked)


def _stop(number: int, frame: object) -> None:
    if (
        os.getpid() != _owner
    ):  # a child that has no handlers of its own yet, or a library's: Ctrl-C is ours to answer
        if number != signal.SIGINT:
            os._exit(CODE)
        return
    if _noted and not _noted[-1]:
        _noted[-1].append(number)
        answer()
        answer_hanging()
        return
    for again in STOPS:
        signal.signal(again, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(MOST_UNDOING_S)
    line = undo_all() or STOPPED
    with suppress(OSError):
        os.write(2, f"scenegen: {line}\n".encode())
    os._exit(CODE)
