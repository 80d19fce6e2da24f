"""A robot's process: what it is told and answers; and that of a robot that is a Python class,
``python -m scenegen.fly.serve module:Class``.

Each message is a line of JSON, ``{"is": "reset" | "act", "arrays": [["ranges", "<f4", [16, 120]],
...]}``, and then the bytes of these arrays, one after the other, little-endian and in C order. To
"reset", the process answers with an empty line once it is ready; to "act", with a line of JSON: an
action, see `scenegen.fly.loop.Robot.act`, or null for none. To either, ``{"error": "…"}`` says what
went wrong, and ends the process.
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
from scenegen.base.errors import MOST_REPEATED, told

ROBOTS = Registry(
    "robot",
    {},
    needs={"reset": "a method: about -> None", "act": "a method: observation -> action"},
)


def encoded(what: str, arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """A message to a robot's process."""
    told = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
    line = json.dumps({"is": what, "arrays": told}).encode()
    return b"\n".join([line, b"".join(array.tobytes() for array in arrays.values())])


def decoded(pipe: IO[bytes]) -> tuple[str, dict[str, NDArray[Any]]] | None:
    """The next message; None where there is none any more."""
    line = pipe.readline()
    if not line:
        return None
    said, arrays = json.loads(line), dict[str, Any]()
    for name, kind, shape in said["arrays"]:
        count = int(np.prod(shape, dtype=np.int64))
        content = pipe.read(count * np.dtype(kind).itemsize)
        arrays[name] = np.frombuffer(content, kind).reshape(shape).copy()
    return str(said["is"]), arrays


def main() -> None:
    """Serve until there are no more messages. What the robot prints goes to standard error."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    robot: Any = None
    while (message := decoded(sys.stdin.buffer)) is not None:
        what, arrays = message
        try:
            if robot is None:
                robot = ROBOTS.find(sys.argv[1])()
            answer = ""
            if what == "reset":
                robot.reset(arrays)
            else:
                answer = _answer(robot.act(arrays))
        except Exception as error:
            if robot is not None:
                traceback.print_exc()
            answer = json.dumps({"error": str(told(error))[:MOST_REPEATED]})
        answers.write(answer.encode() + b"\n")
        answers.flush()


def _answer(action: Any) -> str:
    """An action as a line; null if it is not an array of numbers."""
    numbers = numbers_of(action)
    return json.dumps(None if numbers is None else numbers.tolist())


def numbers_of(action: Any) -> Floats | None:
    """A robot's action as an array. None if it holds anything but real numbers, such as "1" or
    true, which NumPy would convert, or numbers beyond float64."""
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
