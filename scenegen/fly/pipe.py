"""A robot in a process of its own, in any language: it gets observations over a pipe and nothing
else, in bounded time and memory; `messages` says how they talk."""

import json
import os
import resource
import selectors
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

from scenegen.fly.loop import RobotError
from scenegen.fly.messages import encoded
from scenegen.fly.simulation import Observation
from scenegen.limits import MOST_ANSWER_BYTES, ROBOT_BYTES, ROBOT_SECONDS, ROBOT_START_SECONDS
from scenegen.run.workers import die_with_parent

CHUNK = 1 << 16


class PipeRobot:
    """A robot that `command`, its words, starts; see `scenegen.fly.loop.Robot`. The process begins
    with the first flight, and anew after it had to be ended."""

    def __init__(
        self,
        command: Sequence[str],
        *,
        seconds: float = ROBOT_SECONDS,
        memory_bytes: int = ROBOT_BYTES,
    ):
        """A decision may take `seconds`, and the process `memory_bytes` of address space."""
        self._command, self._seconds, self._memory_bytes = list(command), seconds, memory_bytes
        self._process: subprocess.Popen[bytes] | None = None

    def reset(self, about: Observation) -> None:
        """See `Robot.reset`."""
        if self._process is None:
            self._process = self._started()
        self._ask("reset", about, ROBOT_START_SECONDS)

    def act(self, observation: Observation) -> Any:
        """See `Robot.act`."""
        answer = self._ask("act", observation, self._seconds)
        try:
            return json.loads(answer)
        except (ValueError, RecursionError):
            return None

    def close(self) -> None:
        """End the process, and what it began."""
        if self._process is not None:
            with self._process:
                os.killpg(self._process.pid, 9)
                self._process = None

    def _started(self) -> subprocess.Popen[bytes]:
        most = self._memory_bytes

        def limit() -> None:
            die_with_parent()
            resource.setrlimit(resource.RLIMIT_AS, (most, most))

        try:
            process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,
                preexec_fn=limit,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
            )
        except OSError as error:
            raise RobotError("crashed", f"{self._command[0]}: {error.strerror}") from None
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)
        return process

    def _ask(self, what: str, arrays: Observation, seconds: float) -> bytes:
        """The line that the process answers, which is all that it may say meanwhile."""
        try:
            return self._exchange(encoded(what, arrays), seconds)
        except RobotError:
            self.close()
            raise
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


def own_robot(name: str, **limits: Any) -> PipeRobot:
    """One's own robot: ``module:Class``, served by this Python, or a command in quotes."""
    served = [sys.executable, "-m", "scenegen.fly.serve", name]
    command = shlex.split(name) if " " in name or "/" in name else served
    return PipeRobot(command, **limits)
