"""What executors elsewhere have in common: what is sent to other machines, and what comes back.

Function and tasks are sent as bytes, to a function that is itself sent whole: a node that lacks
scenegen, or has another one, can call it and say so. Errors come back as values, and tell the node.
"""

import io
import os
import pickle
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from scenegen.errors import GenerationError, told
from scenegen.run import LOCATED
from scenegen.run.software import identity

GO_ON = "what is written is kept: give the same command again to go on"
"""What to do where a task is lost for good."""


Outcome = tuple[Any, str]
"""What became of a task on another machine: the result, and ""; or the exception and the machine
that raised it, a text in place of the exception where the machine has no scenegen of ours."""


def taken(value: Any, node: str) -> Any:
    """The result of an `Outcome`. Raises its exception, which names the node."""
    if not node:
        return value
    error = GenerationError(value) if isinstance(value, str) else value
    error.args = (f"{error} (on {node})",)
    raise error


def pack(value: Any, pickler: type[pickle.Pickler] = pickle.Pickler) -> bytes:
    """`value` as bytes for other machines. A dataset's folder that `locate` found by a name goes as
    that name, for each machine to open: what was copied here is not there."""

    class Packer(pickler):  # type: ignore[misc, valid-type]
        def persistent_id(self, item: Any) -> Any:
            return LOCATED.get(item) if isinstance(item, Path) else None

    file = io.BytesIO()
    Packer(file).dump(value)
    return file.getvalue()


def _unpack(packed: bytes) -> Any:
    class Unpacker(pickle.Unpickler):
        def persistent_load(self, pid: Any) -> Path:
            open_there, *name = pid
            return open_there(*name)

    return Unpacker(io.BytesIO(packed)).load()


def sent(
    function: Callable[[Any], Any], pickler: type[pickle.Pickler] = pickle.Pickler
) -> Callable[[bytes], Outcome]:
    """`function` as it is sent, for tasks that are packed.

    Pickled by value, as cloudpickle does with functions within functions, it needs no scenegen.
    """
    folder = str(Path.cwd())
    command = pack(function, pickler), identity(), folder, folder in sys.path

    def there(task: bytes) -> Outcome:
        try:
            from scenegen.run.remote import received

            return received(task, *command)
        except ImportError as error:
            from socket import gethostname

            fix = "have the same scenegen, with its extras, on every node"
            return f"no task can be done: {error}; {fix}", gethostname()

    return there


def received(
    task: bytes, parcel: bytes, sender: dict[str, Any], folder: str, importable: bool
) -> Outcome:
    """What comes of a task, on the machine that it was sent to.

    Args:
        task: The task, packed.
        parcel: The function, packed.
        sender: The `identity` of the scenegen that sent both; another one does nothing.
        folder: Where the command was given. The task is done there, if the folder is here, too.
        importable: Whether modules are imported from that folder: a user named one in it.

    Raises:
        ImportError: Something is not installed here.
    """
    try:
        own = identity()
        if own != sender:
            odd = [
                f"{key} {own.get(key)}, not {it}" for key, it in sender.items() if own[key] != it
            ]
            raise GenerationError(
                f"another scenegen there than here: {', '.join(odd)}; have the same on every node; "
                f"{GO_ON}"
            )
        with suppress(OSError):
            os.chdir(folder)
        if importable and folder not in sys.path:
            sys.path.append(folder)  # last, as the registry does
        return _function(parcel)(_unpack(task)), ""
    except ImportError:
        raise
    except Exception as error:  # whatever it is, it is raised where the run was begun
        return told(error), socket.gethostname()


@lru_cache(maxsize=1)
def _function(parcel: bytes) -> Callable[[Any], Any]:
    """The function of a parcel: one object for all tasks of a process, for it may keep something
    from one to the next."""
    return _unpack(parcel)


def named(task: Any) -> str:
    """What a task is about: its file, where it has one."""
    return str(getattr(task, "file", task))[:200]
