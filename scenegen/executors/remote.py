"""What executors elsewhere have in common: errors come back as values, and tell the node."""

import os
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from scenegen.errors import told

GO_ON = "what is written is kept: give the same command again to go on"
"""What to do where a task is lost for good."""


class Outcome(NamedTuple):
    """What became of a task on another machine."""

    value: Any
    """The result, or the exception."""
    node: str
    """The machine that raised it; "" for a result."""

    def taken(self) -> Any:
        """The result. Raises the exception, which names the node."""
        if self.node:
            self.value.args = (f"{self.value} (on {self.node})",)
            raise self.value
        return self.value


def attempt(function: Callable[[Any], Any], task: Any, folder: Path) -> Outcome:
    """`function` of `task`, in the `folder` where the command was given if it is there; whatever comes of it."""
    try:
        with suppress(OSError):
            os.chdir(folder)
        return Outcome(function(task), "")
    except Exception as error:  # whatever it is, it is raised where the run was begun
        return Outcome(told(error), socket.gethostname())


def named(task: Any) -> str:
    """What a task is about: its file, where it has one."""
    return str(getattr(task, "file", task))[:200]
