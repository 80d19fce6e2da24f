"""docs/troubleshooting.md quotes messages that the code has."""

import re

import pytest

from tests.command_line import ROOT, page

ROWS = re.findall(r"^\| `([^`]+)` \|", page("troubleshooting.md"), re.MULTILINE)
SOURCES = [
    path.read_text(encoding="utf-8")
    for folder in ("lidarsim", "scenegen", "model")
    for path in sorted((ROOT / folder).rglob("*.py"))
]
JOINED = re.sub(r'"\s*f?"', "", "".join(SOURCES))
"""All code, with strings that stand one after the other as one."""


def test_there_are_twenty_or_more():
    assert len(ROWS) >= 20


@pytest.mark.parametrize("message", ROWS)
def test_every_piece_of_a_message_stands_in_the_code(message):
    pieces = [piece.strip(" ;:(),'`") for piece in message.split("…")]
    said = [piece for piece in pieces if len(piece) > 12]
    assert said or message.startswith("unknown")
    assert [piece for piece in said if piece not in JOINED] == []
