"""The process of a robot that is a Python class: ``python -m scenegen.fly.serve module:Class``."""

import json
import os
import sys

import numpy as np

from lidarsim.registry import Registry
from scenegen.fly.messages import decoded

ROBOTS = Registry(
    "robot",
    {},
    needs={"reset": "a method: about -> None", "act": "a method: observation -> action"},
)


def main() -> None:
    """Serve until there are no more messages. What the robot prints goes to standard error."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        robot = ROBOTS.find(sys.argv[1])()
    except ValueError as error:
        sys.exit(str(error))
    while (message := decoded(sys.stdin.buffer)) is not None:
        what, arrays = message
        answer = ""
        if what == "reset":
            robot.reset(arrays)
        else:
            action = robot.act(arrays)
            answer = json.dumps(None if action is None else np.asarray(action, float).tolist())
        answers.write(answer.encode() + b"\n")
        answers.flush()


if __name__ == "__main__":
    main()
