"""A robot in a process of its own, in any language: it gets observations over a pipe and nothing
else, in bounded time and memory; `serve` says how they talk, and `keep` keeps it in."""

import json
import os
import selectors
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

from scenegen.base.errors import MOST_REPEATED, printable
from scenegen.base.limits import MOST_ANSWER_BYTES, ROBOT_BYTES, ROBOT_SECONDS, ROBOT_START_SECONDS
from scenegen.fly.loop import RobotError
from scenegen.fly.serve import encoded
from scenegen.fly.simulation import Observation

CHUNK = 1 << 16
KEEPER = str(Path(__file__).with_name("keep.py"))
MOST_HANGS = 3
"""Flights in a row that may wait in vain for a robot to begin."""
ENDING_S = 5.0
"""How long its keeper may take to end a robot, seconds."""
_hangs = Counter[str]()
"""In a row, of each command."""


@dataclass
class PipeRobot:
    """A robot that `command`, its words, starts; see `scenegen.fly.loop.Robot`. The process begins
    with the first flight, and anew after it had to be ended."""

    command: Sequence[str]
    _: KW_ONLY
    seconds: float = ROBOT_SECONDS
    """A decision may take so long."""
    start_seconds: float = ROBOT_START_SECONDS
    """The beginning of a flight may take so long."""
    memory_bytes: int = ROBOT_BYTES
    """Address space of the process."""
    _process: subprocess.Popen[bytes] | None = field(default=None, init=False)

    def reset(self, about: Observation) -> None:
        """See `Robot.reset`. A command that hung here `MOST_HANGS` times in a row is not asked
        again by this process."""
        name = shlex.join(self.command)
        if _hangs[name] >= MOST_HANGS:
            raise RobotError("hung", f"the robot hung in reset {MOST_HANGS} times in a row")
        if self._process is None:
            self._process = self._started()
        try:
            self._ask("reset", about, self.start_seconds)
        except RobotError as error:
            _hangs[name] += error.outcome == "hung"
            raise
        _hangs[name] = 0

    def act(self, observation: Observation) -> Any:
        """See `Robot.act`."""
        return self._ask("act", observation, self.seconds)

    def close(self) -> None:
        """End the process, and what it began: by its keeper, or else by its group."""
        if self._process is not None:
            with self._process:
                # not by `Popen`, after which the group's number could be another's
                keeper, self._process = self._process.pid, None
                os.kill(keeper, signal.SIGTERM)
                deadline, how = time.monotonic() + ENDING_S, os.WEXITED | os.WNOHANG | os.WNOWAIT
                while not os.waitid(os.P_PID, keeper, how) and time.monotonic() < deadline:
                    time.sleep(0.001)
                os.killpg(keeper, signal.SIGKILL)

    def _started(self) -> subprocess.Popen[bytes]:
        if shutil.which(self.command[0]) is None:
            raise RobotError("crashed", f"{self.command[0]}: there is no such program")
        cores = sorted(os.sched_getaffinity(0))
        # neighbouring workers have neighbouring numbers, and so cores of their own
        limits = (self.memory_bytes, cores[os.getpid() % len(cores)])
        process = subprocess.Popen(
            [sys.executable, "-I", "-S", KEEPER, *map(str, limits), *self.command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)
        return process

    def _ask(self, what: str, arrays: Observation, seconds: float) -> Any:
        """The line that the process answers, which is all that it may say meanwhile, as JSON; None
        where it is none."""
        try:
            answer = json.loads(self._exchange(encoded(what, arrays), seconds))
            if isinstance(answer, dict) and "error" in answer:
                raise RobotError(
                    "crashed", f"the robot ended: {printable(answer['error'])[:MOST_REPEATED]}"
                )
            return answer
        except RobotError:
            self.close()
            raise
        except (ValueError, RecursionError):
            return None
        except OSError as error:
            self.close()
            raise RobotError("crashed", f"the robot's process ended: {error.strerror}") from None

    def _exchange(self, message: bytes, seconds: float) -> bytes:
        process, left, said = self._process, memoryview(message), b""
        if process is None:
            raise RobotError("crashed", "the robot's process has ended")
        deadline = time.monotonic() + seconds
        with selectors.DefaultSelector() as ready:
            ready.register(process.stdin, selectors.EVENT_WRITE)  # type: ignore[arg-type]
            ready.register(process.stdout, selectors.EVENT_READ)  # type: ignore[arg-type]
            while left or not said.endswith(b"\n"):
                for key, events in ready.select(max(deadline - time.monotonic(), 0.0)):
                    if events & selectors.EVENT_WRITE:
                        left = left[os.write(key.fd, left[:CHUNK]) :]
                        if not left:
                            ready.unregister(key.fileobj)
                    else:
                        part = os.read(key.fd, CHUNK)
                        said += part
                        if not part:
                            raise RobotError("crashed", "the robot's process ended")
                if len(said) > MOST_ANSWER_BYTES or said[:-1].count(b"\n") or (said and left):
                    raise RobotError(
                        "flooded",
                        f"the robot said {said[:40]!a}…; expected one line for each observation, "
                        f"of {MOST_ANSWER_BYTES} bytes at most",
                    )
                if time.monotonic() >= deadline:
                    raise RobotError("hung", f"the robot gave no answer in {seconds:g} s")
        return said


def own_robot(name: str) -> PipeRobot:
    """One's own robot: ``module:Class``, served by this Python, or a command in quotes."""
    served = [sys.executable, "-m", "scenegen.fly.serve", name]
    command = shlex.split(name) if " " in name or "/" in name else served
    return PipeRobot(command)
