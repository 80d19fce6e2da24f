"""The keeper of a robot's process: ``python -I -S keep.py BYTES CORE COMMAND…``.

It limits the robot's memory, pins it to one core, and passes on the first `MAX_STDERR_BYTES` of the
standard error of the robot and its descendants. The robot inherits the keeper's standard input and
output. When the robot ends, the keeper gets SIGTERM, or the keeper's parent ends, all descendants
of the robot are killed, also those in other sessions: as their subreaper, the keeper becomes the
parent of orphans.

This script imports nothing of scenegen, so that it starts within milliseconds.
"""

import ctypes
import os
import resource
import signal
import sys
import threading
from pathlib import Path

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
"""Linux's options of prctl(2)."""
MAX_STDERR_BYTES = 16 << 10
"""Maximum of standard error that is passed on."""


def main() -> None:
    """Run the robot until it ends or has to, then kill its descendants."""
    memory_bytes, core, *command = sys.argv[1:]
    prctl = ctypes.CDLL(None).prctl
    prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    prctl(PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    # an exception, so that `finally` below runs
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    os.sched_setaffinity(0, {int(core)})
    read_end, write_end = os.pipe()
    robot = os.fork()
    if not robot:
        # until it executes the command, the child has the keeper's handler
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        # children do not inherit this setting: without it, the robot would survive its keeper
        prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        # address space, not resident memory, which Linux cannot limit so
        resource.setrlimit(resource.RLIMIT_AS, (int(memory_bytes), int(memory_bytes)))
        os.dup2(write_end, 2)
        os.execvp(command[0], command)
    for number in (
        0,
        1,
        write_end,
    ):  # only the robot holds them now, so that they close when it ends
        os.close(number)
    listener = threading.Thread(target=_pass_on, args=(read_end,), daemon=True)
    listener.start()
    try:
        # orphans of the robot end here, too: only its own end counts
        while os.wait()[0] != robot:
            pass
    finally:
        # a second SIGTERM must not end this before all are killed
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        _end_children()
        listener.join(1)  # what is in the pipe is passed on, for a second at most


def _pass_on(read_end: int) -> None:
    """Copy a pipe to standard error up to the limit, and discard the rest: a full pipe would block
    the robot."""
    left = MAX_STDERR_BYTES
    while part := os.read(read_end, 1 << 16):
        os.write(2, part[:left])
        left = max(left - len(part), 0)


def _end_children() -> None:
    """Kill all descendants, generation by generation: orphans become children of this process."""
    me = os.getpid()
    while True:
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                # the second field is a name in parentheses, which may hold blanks and parentheses
                parent = int(stat.read_text(errors="replace").rpartition(")")[2].split()[1])
                if parent == me:
                    os.kill(int(stat.parent.name), signal.SIGKILL)
            except OSError:  # it ended in the meantime
                continue
        try:
            os.wait()
        except ChildProcessError:
            return


if __name__ == "__main__":
    main()
