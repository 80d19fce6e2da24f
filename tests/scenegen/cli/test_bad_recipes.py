"""A recipe that cannot be is refused in one line."""

import os

import pytest

from tests.command_line import refused, rows

BAD_RECIPES = """
world.densty = [0.1, 0.2]  → [world]: unknown parameter 'densty'; did you mean 'density'?
wrld.density = [0.1, 0.2]  → unknown table 'wrld'
density = [0.1, 0.2]       → density stands in no table; expected it below the line [world]
flight.viewpoints = 'five' → viewpoints = 'five'
flight.margin_m = 30.0     → margin_m = 30
world = {round_share = 0.8, oblong_share = 0.5}      → expected at most 1
world.density = [90, 90]   → expected 20000 at most
world = 3                  → expected a table
kind = "geometric"         → is a recipe for kind 'geometric'
density = = 3              → not valid TOML
world."\\u001b[2Jall\\nright" = 1     → unknown parameter '\\x1b[2Jall\\nright'
flight.spacing_m = 1e-7    → spacing_m = 1e-07: expected
flight.spacing_m = 0.001   → places to scan from along one flight
grid.shape = [408, 408, 408]           → 67917312 voxels, expected 67108864 at most
grid = {voxel_m = 90.0, truncation_m = 90.0}         → voxel_m = 90.0: expected at most the
world = {size_m = [1e6, 1e6, 10], density = [0, 0]}  → size_m = [1000000.0, 10
"""
DRAWS = "accept.max_draws = 10000\n[flight]\nflights_per_world = 1000\niterations = 1000000"
LARGE = [
    (f"grid.voxel_m = {'9' * 9000}", "not valid TOML"),
    (f"grid.shape = {'[' * 5000}{']' * 5000}", "nested too deeply"),
    (f"{'a.' * 30_000}a = 1", "nested too deeply"),
    (f"kind = 'pillar' # {'x' * (1 << 16)}", "bytes, expected 65536 at most"),
    (DRAWS, "expected 1000000000 at most; lower one of them"),
    ("grid.shape = [400, 400, 400]\nflight.viewpoints = 17", "expected 16 at most"),
]


@pytest.mark.parametrize(("text", "told"), [*rows(BAD_RECIPES), *LARGE], ids=lambda it: it[:30])
def test_a_bad_recipe_ends_in_one_line(text, told, tmp_path, capsys):
    (tmp_path / "r.toml").write_text(text)
    command = f"generate pillar --recipe {tmp_path / 'r.toml'} --n 5 --quiet --out {tmp_path / 'd'}"
    assert told in refused(capsys, command)


def test_a_recipe_that_is_no_file_ends_in_one_line(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.toml")
    for path, told in (("pipe.toml", "not a regular file"), ("gone.toml", "no such file")):
        command = f"generate --recipe {tmp_path / path} --out {tmp_path / 'd'} --quiet"
        assert told in refused(capsys, command)
