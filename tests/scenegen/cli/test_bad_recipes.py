"""A recipe that cannot be is refused in one line."""

import os

import pytest

from tests.command_line import refused

BAD_RECIPES = {
    "unknown parameter": (
        "[world]\ndensty = [0.1, 0.2]",
        "[world]: unknown parameter 'densty'; did you mean 'density'?",
    ),
    "unknown table": ("[wrld]\ndensity = [0.1, 0.2]", "unknown table 'wrld'"),
    "a parameter in no table": (
        "density = [0.1, 0.2]",
        "density stands in no table; expected it below the line [world]",
    ),
    "wrong type": ("[flight]\nviewpoints = 'five'", "viewpoints = 'five'"),
    "no room": ("[flight]\nmargin_m = 30.0", "margin_m = 30"),
    "shares above one": ("[world]\nround_share = 0.8\noblong_share = 0.5", "expected at most 1"),
    "too many": ("[world]\ndensity = [90, 90]", "expected 20000 at most"),
    "no table": ("world = 3", "expected a table"),
    "wrong kind": ('kind = "geometric"', "is a recipe for kind 'geometric'"),
    "a key that prints": (
        '[world]\n"\\u001b[2Jall\\nright" = 1',
        "unknown parameter '\\x1b[2Jall\\nright'",
    ),
    "more digits than int takes": (f"[grid]\nvoxel_m = {'9' * 9000}", "not valid TOML"),
    "deep arrays": (f"[grid]\nshape = {'[' * 5000}{']' * 5000}", "nested too deeply"),
    "deep keys": (f"{'a.' * 30_000}a = 1", "nested too deeply"),
    "too large": (f"kind = 'pillar' # {'x' * (1 << 16)}", "bytes, expected 65536 at most"),
    "no end of places": ("[flight]\nspacing_m = 1e-7", "spacing_m = 1e-07: expected"),
    "a million places": ("[flight]\nspacing_m = 0.001", "places to scan from along one flight"),
    "draws of flights of searches": (
        "[accept]\nmax_draws = 10000\n[flight]\nflights_per_world = 1000\niterations = 1000000",
        "expected 1000000000 at most; lower one of them",
    ),
    "maps beyond what is read": ("[grid]\nshape = [408, 408, 408]", "67917312 voxels, expected"),
    "maps beyond memory": (
        "[grid]\nshape = [400, 400, 400]\n[flight]\nviewpoints = 17",
        "expected 16 at most",
    ),
    "voxels beyond the rays": (
        "[grid]\nvoxel_m = 90.0\ntruncation_m = 90.0",
        "voxel_m = 90.0: expected at most the",
    ),
    "a world as wide as a country": (
        "[world]\nsize_m = [1e6, 1e6, 10]\ndensity = [0, 0]",
        "size_m = [1000000.0, 10",
    ),
}


@pytest.mark.parametrize("what", BAD_RECIPES)
def test_a_bad_recipe_ends_in_one_line(what, tmp_path, capsys):
    text, named = BAD_RECIPES[what]
    (tmp_path / "r.toml").write_text(text)
    command = f"generate pillar --recipe {tmp_path / 'r.toml'} --n 5 --quiet --out {tmp_path / 'd'}"
    assert named in refused(capsys, command)


def test_a_recipe_that_is_no_file_ends_in_one_line(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.toml")
    for path, named in (
        ("pipe.toml", "not a regular file"),
        ("", "not a regular file"),
        ("gone.toml", "no such file"),
    ):
        command = f"generate --recipe {tmp_path / path} --out {tmp_path / 'd'} --quiet"
        assert named in refused(capsys, command)
