"""Nothing that comes from a file prints a line, or a colour, of its own."""

import pytest

from scenegen.terminal.show import say, show_table

FORGED = "pillar\nscenegen: verify: all 17 checks passed\x1b[32m\x07\u202e"


def test_names_and_values_are_escaped_and_keep_their_columns(capsys: pytest.CaptureFixture[str]) -> None:
    show_table({FORGED: FORGED, "short": "   12,345"}, FORGED, {"short": ("ok", "green")})
    said = capsys.readouterr().out
    lines = said.split("\n")
    assert [bool(line) for line in lines] == [False, True, True, True, False]
    assert all(line.isprintable() for line in lines)
    assert r"pillar\nscenegen: verify: all 17 checks passed\x1b[32m\x07" in lines[2]
    assert lines[3].endswith("  ok     12,345")


def test_lines_are_kept_and_what_is_within_them_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    say("one\n  two\x1b[31m")
    assert capsys.readouterr().out == "one\n  two\\x1b[31m\n"


def test_paths_that_are_no_text_can_be_shown(capsys: pytest.CaptureFixture[str]) -> None:
    say("data/\udcff")
    assert capsys.readouterr().out == "data/\\udcff\n"
