"""A robot in another process, in any language. It gets observations over a pipe and nothing else,
in bounded time and memory. `serve` describes the messages; `keep` bounds the process."""

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

from scenegen.base.errors import MAX_REPEATED, printable
from scenegen.base.limits import MAX_ANSWER_BYTES, ROBOT_BYTES, ROBOT_SECONDS, ROBOT_START_SECONDS
from scenegen.fly.loop import RobotError
from scenegen.fly.serve import encoded
from scenegen.fly.simulation import Observation

CHUNK = 1 << 16
"""Maximum bytes of a read or write: a pipe's buffer."""
KEEPER = str(Path(__file__).with_name("keep.py"))
MAX_HANGS = 3
"""Maximum flights in a row in which a robot hangs in `reset`."""
ENDING_S = 5.0
"""Maximum time that the keeper takes to end a robot, seconds."""
# counted beyond single robots, since every course makes a robot of its own
_hangs = Counter[str]()
"""Flights in a row in which each command hung in `reset`."""


@dataclass
class PipeRobot:
    """A robot in another process, see `scenegen.fly.loop.Robot`. The process starts with the first
    flight, and again after a failure."""

    command: Sequence[str]
    """The command that starts it, in words."""
    _: KW_ONLY
    seconds: float = ROBOT_SECONDS
    """Maximum time of a decision."""
    start_seconds: float = ROBOT_START_SECONDS
    """Maximum time of `reset`, in which networks are loaded."""
    memory_bytes: int = ROBOT_BYTES
    """Maximum address space of the process."""
    _process: subprocess.Popen[bytes] | None = field(default=None, init=False)

    def reset(self, about: Observation) -> None:
        """Begin a flight, see `Robot.reset`.

        Args:
            about: See `Simulation.about`.

        Raises:
            RobotError: The robot fails, hangs, or has hung here `MAX_HANGS` times in a row.
        """
        name = shlex.join(self.command)
        # each hang costs `start_seconds`: a suite of many flights would wait for hours
        if _hangs[name] >= MAX_HANGS:
            raise RobotError("hung", f"the robot hung in reset {MAX_HANGS} times in a row")
        if self._process is None:
            self._process = self._start()
        try:
            self._ask("reset", about, self.start_seconds)
        except RobotError as error:
            _hangs[name] += error.outcome == "hung"
            raise
        _hangs[name] = 0

    def act(self, observation: Observation) -> Any:
        """Decide, see `Robot.act`. Raises RobotError if the robot fails or hangs."""
        return self._ask("act", observation, self.seconds)

    def close(self) -> None:
        """End the process and its descendants: by its keeper, and then by its process group."""
        if self._process is not None:
            with self._process:
                # without reaping it: until then, no other process group can get its number
                keeper, self._process = self._process.pid, None
                os.kill(keeper, signal.SIGTERM)
                deadline, how = time.monotonic() + ENDING_S, os.WEXITED | os.WNOHANG | os.WNOWAIT
                while not os.waitid(os.P_PID, keeper, how) and time.monotonic() < deadline:
                    time.sleep(0.001)
                os.killpg(keeper, signal.SIGKILL)

    def _start(self) -> subprocess.Popen[bytes]:
        if shutil.which(self.command[0]) is None:
            raise RobotError("crashed", f"{self.command[0]}: there is no such program")
        cores = sorted(os.sched_getaffinity(0))
        # workers that start together have consecutive ids, and so different cores
        limits = (self.memory_bytes, cores[os.getpid() % len(cores)])
        process = subprocess.Popen(
            # without `site` it starts faster; isolated, it imports nothing of the working folder
            [sys.executable, "-I", "-S", KEEPER, *map(str, limits), *self.command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # a process group of its own, which `close` can kill
            start_new_session=True,
            # one core, one thread: more would only wait for one another
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        # a full pipe must not block us: `_exchange` keeps the time
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)
        return process

    def _ask(self, kind: str, arrays: Observation, seconds: float) -> Any:
        """Send a message and return the robot's answer, decoded; None if it is not JSON.

        Raises:
            RobotError: The robot failed, hung, or wrote more than one line. Its process is ended.
        """
        try:
            answer = json.loads(self._exchange(encoded(kind, arrays), seconds))
            if isinstance(answer, dict) and "error" in answer:
                raise RobotError(
                    "crashed", f"the robot ended: {printable(answer['error'])[:MAX_REPEATED]}"
                )
            return answer
        except RobotError:
            self.close()
            raise
        except (ValueError, RecursionError):
            return None  # an invalid answer is counted, and the flight goes on
        except OSError as error:
            self.close()
            raise RobotError("crashed", f"the robot's process ended: {error.strerror}") from None

    def _exchange(self, message: bytes, seconds: float) -> bytes:
        """Write a message and read a line, at the same time: a robot that does not read must not
        block us. Raises RobotError; see `_ask`."""
        process, left, answer = self._process, memoryview(message), b""
        if process is None:
            raise RobotError("crashed", "the robot's process has ended")
        deadline = time.monotonic() + seconds
        with selectors.DefaultSelector() as ready:
            ready.register(process.stdin, selectors.EVENT_WRITE)  # type: ignore[arg-type]
            ready.register(process.stdout, selectors.EVENT_READ)  # type: ignore[arg-type]
            while left or not answer.endswith(b"\n"):
                for key, events in ready.select(max(deadline - time.monotonic(), 0.0)):
                    if events & selectors.EVENT_WRITE:
                        left = left[os.write(key.fd, left[:CHUNK]) :]
                        if not left:
                            ready.unregister(key.fileobj)
                    else:
                        part = os.read(key.fd, CHUNK)
                        answer += part
                        if not part:
                            raise RobotError("crashed", "the robot's process ended")
                # an answer before the whole message was sent is no answer to it
                if len(answer) > MAX_ANSWER_BYTES or answer[:-1].count(b"\n") or (answer and left):
                    raise RobotError(
                        "flooded",
                        f"the robot said {answer[:40]!a}…; expected one line for each observation, "
                        f"of {MAX_ANSWER_BYTES} bytes at most",
                    )
                if time.monotonic() >= deadline:
                    raise RobotError("hung", f"the robot gave no answer in {seconds:g} s")
        return answer


def own_robot(name: str) -> PipeRobot:
    """Return a user's own robot: ``module:Class``, run by this Python, or a command."""
    served = [sys.executable, "-m", "scenegen.fly.serve", name]
    # module:Class has neither blanks nor slashes
    command = shlex.split(name) if " " in name or "/" in name else served
    return PipeRobot(command)
