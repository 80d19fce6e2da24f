"""Handles stops (Ctrl-C, SIGTERM, SIGHUP) at any moment: unfinished work is undone, one line is
printed, and the process ends.

The process ends within the signal handler. An exception could be swallowed or printed by a
library's callback. This file imports nothing slow, so that a command can begin with it.
"""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from scenegen.base.executors import undo_all

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that stop a command."""
STOPPED = "stopped; finished files are kept: give the same command again"
"""Line of a stopped command."""
CODE = 130
"""Exit code of a stopped command, as shells have it for Ctrl-C."""
MAX_UNDO_S = 20
"""Maximum time to undo unfinished work, seconds; then the kernel ends the process."""
_owner = 0
"""Id of the process that is the command, not one of its children."""
_noted: list[list[int]] = []
"""Signals received in each `noted`, the innermost last."""


def is_command() -> bool:
    """Whether this process is the command line, rather than a program that imports it."""
    name = os.path.basename(sys.argv[0])  # noqa: PTH119 (pathlib takes time)
    return name in ("scenegen", "scenegen-lidar", "cli.py")


def answer() -> None:
    """Let a stop end this process from now on."""
    global _owner
    # forks inherit the handlers: they tell by this whose signal it is
    _owner = os.getpid()
    for number in STOPS:
        signal.signal(number, _stop)


def answer_hanging() -> None:
    """Let a second stop end this process even if it hangs in a library.

    Python's C handler only notes a signal, and runs ours when the library returns. With
    `sysv_signal` the kernel removes the handler after the first signal, so the second one kills.
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
    """Note a first stop, for a loop that checks whether to end; a second stop ends the process.

    Yields:
        A function: whether a stop was noted.
    """
    signals: list[int] = []
    _noted.append(signals)
    try:
        yield lambda: bool(signals)
    finally:
        _noted.remove(signals)


def _stop(number: int, frame: object) -> None:
    """Handle a signal: note it, or undo unfinished work and end the process."""
    # a child without handlers of its own yet, or a library's: the owner answers Ctrl-C for all
    if os.getpid() != _owner:
        if number != signal.SIGINT:
            os._exit(CODE)
        return
    if _noted and not _noted[-1]:
        _noted[-1].append(number)
        # armed again: the second stop must end even a loop that hangs
        answer()
        answer_hanging()
        return
    # further stops must not interrupt the undoing, but it must not take for ever either
    for ignored in STOPS:
        signal.signal(ignored, signal.SIG_IGN)
    # the kernel's own action: a handler in Python would wait while a library hangs
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(MAX_UNDO_S)
    line = undo_all() or STOPPED
    with suppress(OSError):
        # not print: a lock of the stream may be held where the signal came
        os.write(2, f"scenegen: {line}\n".encode())
    os._exit(CODE)
