"""What a robot's process is told, and answers.

Each message is a line of JSON, ``{"is": "reset" | "act", "arrays": [["ranges", "<f4", [16, 120]],
...]}``, and then the bytes of these arrays, one after the other, little-endian and in C order. To
"reset", the process answers with an empty line once it is ready; to "act", with a line of JSON: an
action, see `scenegen.fly.loop.Robot.act`, or null for none.
"""

import json
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray


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
