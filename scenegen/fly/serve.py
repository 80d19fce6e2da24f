"""The messages between a flight and a robot's process, and the process of a robot that is a Python
class: ``python -m scenegen.fly.serve module:Class``.

Each message is a line of JSON, ``{"is": "reset" | "act", "arrays": [["ranges", "<f4", [16, 120]],
...]}``, and then the bytes of these arrays, one after the other, little-endian and in C order. To
"reset", the process answers with an empty line once it is ready; to "act", with a line of JSON: an
action, see `scenegen.fly.loop.Robot.act`, or null for none. To either, ``{"error": "…"}`` reports a
failure, after which the process is ended.
"""

import json
import os
import sys
import traceback
from collections.abc import Mapping
from numbers import Real
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats
from lidarsim.registry import Registry
from scenegen.base.errors import MAX_REPEATED, as_own_code_error

ROBOTS = Registry(
    "robot",
    {},
    needs={"reset": "a method: about -> None", "act": "a method: observation -> action"},
)


def encoded(kind: str, arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Encode a message to a robot's process.

    Args:
        kind: "reset" or "act".
        arrays: Arrays by name, little-endian.
    """
    headers = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
    line = json.dumps({"is": kind, "arrays": headers}).encode()
    return b"\n".join([line, b"".join(array.tobytes() for array in arrays.values())])


def decoded(pipe: IO[bytes]) -> tuple[str, dict[str, NDArray[Any]]] | None:
    """Read the next message: its kind and its arrays; None at the end of the pipe."""
    line = pipe.readline()
    if not line:
        return None
    header, arrays = json.loads(line), dict[str, Any]()
    for name, kind, shape in header["arrays"]:
        count = int(np.prod(shape, dtype=np.int64))
        content = pipe.read(count * np.dtype(kind).itemsize)
        # copied: an array over bytes is read-only, and the robot may change its own
        arrays[name] = np.frombuffer(content, kind).reshape(shape).copy()
    return str(header["is"]), arrays


def main() -> None:
    """Serve until the pipe ends. What the robot prints goes to standard error."""
    # standard output carries the answers, so a robot's print() must not reach it
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    robot: Any = None
    while (message := decoded(sys.stdin.buffer)) is not None:
        kind, arrays = message
        try:
            # made at the first message, so that an import error is an answer, too
            if robot is None:
                robot = ROBOTS.find(sys.argv[1])()
            answer = ""
            if kind == "reset":
                robot.reset(arrays)
            else:
                answer = _answer(robot.act(arrays))
        except Exception as error:
            if robot is not None:
                traceback.print_exc()
            answer = json.dumps({"error": str(as_own_code_error(error))[:MAX_REPEATED]})
        answers.write(answer.encode() + b"\n")
        answers.flush()


def _answer(action: Any) -> str:
    """Encode an action as JSON; null if it is not an array of numbers."""
    numbers = numbers_of(action)
    return json.dumps(None if numbers is None else numbers.tolist())


def numbers_of(action: Any) -> Floats | None:
    """Return a robot's action as an array. None if it holds anything but real numbers, such as "1"
    or true, which NumPy would convert, or numbers beyond float64."""
    try:
        parts = np.asarray(action, object)
        values = [part.item() if hasattr(part, "item") else part for part in parts.flat]
        if any(isinstance(value, bool) or not isinstance(value, Real) for value in values):
            return None
        return np.array(values, float).reshape(parts.shape)
    except (TypeError, ValueError, OverflowError):
        return None


if __name__ == "__main__":
    main()
