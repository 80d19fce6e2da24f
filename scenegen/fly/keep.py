"""The keeper of a robot's process: ``python -I -S keep.py BYTES CORE COMMAND…``.

It limits the robot's memory, has it run on one core, and passes on the first `MOST_SAID` bytes that
the robot and all that it begins say on standard error. The robot talks over the keeper's standard
streams. When the robot ends, or the keeper is told to by SIGTERM, or its own parent ends, all
processes that the robot began are ended, those that left its session, too: as their subreaper, the
keeper becomes the parent of those that lost theirs.

This is a script that imports nothing of scenegen, so that it starts within milliseconds.
"""

import ctypes
import os
import resource
import signal
import sys
import threading
from pathlib import Path

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
"""Linux's names for them."""
MOST_SAID = 16 << 10
"""Bytes of standard error that are passed on."""


def main() -> None:
    """Keep a robot until it ends, or has to."""
    memory_bytes, core, *command = sys.argv[1:]
    prctl = ctypes.CDLL(None).prctl
    prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    prctl(PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    os.sched_setaffinity(0, {int(core)})
    heard, said = os.pipe()
    robot = os.fork()
    if not robot:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        resource.setrlimit(resource.RLIMIT_AS, (int(memory_bytes), int(memory_bytes)))
        os.dup2(said, 2)
        os.execvp(command[0], command)
    for number in (0, 1, said):  # the robot alone has them, so that their end is its own
        os.close(number)
    listener = threading.Thread(target=_pass_on, args=(heard,), daemon=True)
    listener.start()
    try:
        while os.wait()[0] != robot:
            pass
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        _end_children()
        listener.join(1)


def _pass_on(heard: int) -> None:
    """Repeat what comes through a pipe, up to a limit, and swallow the rest."""
    left = MOST_SAID
    while part := os.read(heard, 1 << 16):
        os.write(2, part[:left])
        left = max(left - len(part), 0)


def _end_children() -> None:
    """End all descendants: children of one that ends become children of this process."""
    me = os.getpid()
    while True:
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                parent = int(stat.read_text(errors="replace").rpartition(")")[2].split()[1])
                if parent == me:
                    os.kill(int(stat.parent.name), signal.SIGKILL)
            except OSError:  # it has ended by itself
                continue
        try:
            os.wait()
        except ChildProcessError:
            return


if __name__ == "__main__":
    main()
