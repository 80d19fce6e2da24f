"""Inside `model/`, too, imports run one way: commands, training, evaluation, completion, the network."""

import re
from pathlib import Path

from tests.test_imports import imported

MODEL = Path(__file__).parents[2] / "model"
ROOMS = ("completion", "evaluation", "training")
"""From the lowest; the files at the top of `model/` lie below them all, commands above."""


def test_a_room_imports_none_above_it() -> None:
    floors = [sorted(MODEL.glob("*.py")), *(sorted((MODEL / room).rglob("*.py")) for room in ROOMS)]
    assert all(floors)
    for below, files in enumerate(floors):
        above = re.compile(rf"scenegen\.model\.({'|'.join((*ROOMS[below:], 'commands', 'bench'))})\b")
        for path in files:
            if path.name != "train_command.py":  # a command
                assert not [name for name in imported(path) if above.match(name)], path
