"""What executors elsewhere have in common: errors come back as values, and tell the node."""

import socket
from collections.abc import Callable
from typing import Any, NamedTuple


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


def attempt(function: Callable[[Any], Any], task: Any) -> Outcome:
    """`function` of `task`, whatever comes of it."""
    try:
        return Outcome(function(task), "")
    except Exception as error:  # whatever it is, it is raised where the run was begun
        return Outcome(error, socket.gethostname())


def named(task: Any) -> str:
    """What a task is about: the file that it writes, where it has one."""
    return str(getattr(task, "file", task))[:200]
