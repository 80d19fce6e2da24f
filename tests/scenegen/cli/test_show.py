"""Nothing that comes from a file prints a line, or a colour, of its own."""

import itertools

import pytest

from scenegen.cli.show import echo, show_columns, show_table

FORGED = "pillar\nscenegen: verify: all 17 checks passed\x1b[32m\x07\u202e"


def test_names_and_values_are_escaped_and_keep_their_columns(capsys):
    show_table({FORGED: FORGED, "short": "   12,345"}, FORGED, {"short": ("ok", "green")})
    said = capsys.readouterr().out
    lines = said.split("\n")
    assert [bool(line) for line in lines] == [False, True, True, True, False]
    assert all(line.isprintable() for line in lines)
    assert r"pillar\nscenegen: verify: all 17 checks passed\x1b[32m\x07" in lines[2]
    assert lines[3].endswith("  ok     12,345")


def test_lines_are_kept_and_what_is_within_them_is_not(capsys):
    echo("one\n  two\x1b[31m\udcff")
    assert capsys.readouterr().out == "one\n  two\\x1b[31m\\udcff\n"


@pytest.mark.parametrize("wide", [10, 80])
def test_figures_fit_the_terminal_and_none_is_left_out(wide, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(wide))
    heads, values = ([text.format(n) for n in range(12)] for text in ("metric_{}", "{}.5"))
    show_columns({"one": values, "another": ["–"] * 12}, heads, "a title")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= max(wide, len("another  metric_11"))
    assert " ".join(lines).count("–") == 12
    below = {}
    for upper, lower in itertools.pairwise(map(str.split, lines)):
        below |= zip(upper, lower[1:], strict=False)
    assert [below[head] for head in heads] == values
