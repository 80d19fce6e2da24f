"""A recipe that cannot be is refused in one line."""

import os

import pytest

from tests.command_line import refused
from tests.scenegen import cases

DRAWS = "accept.max_draws = 10000\n[flight]\nflights_per_world = 1000\niterations = 1000000"
LARGE = [
    (f"grid.voxel_m = {'9' * 9000}", "not valid TOML"),
    (f"grid.shape = {'[' * 5000}{']' * 5000}", "nested too deeply"),
    (f"{'a.' * 30_000}a = 1", "nested too deeply"),
    (f"kind = 'pillar' # {'x' * (1 << 16)}", "bytes, expected 65536 at most"),
    (DRAWS, "expected 1000000000 at most; lower one of them"),
    ("grid.shape = [400, 400, 400]\nflight.viewpoints = 17", "expected 16 at most"),
]


@pytest.mark.parametrize(
    ("text", "told"), [*cases("cli/bad_recipes"), *LARGE], ids=lambda it: it[:30]
)
def test_a_bad_recipe_ends_in_one_line(text, told, tmp_path, capsys):
    (tmp_path / "r.toml").write_text(text)
    command = f"generate pillar --recipe {tmp_path / 'r.toml'} --n 5 --quiet --out {tmp_path / 'd'}"
    assert told in refused(capsys, command)


def test_a_recipe_that_is_no_file_ends_in_one_line(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.toml")
    for path, told in (("pipe.toml", "not a regular file"), ("gone.toml", "no such file")):
        command = f"generate --recipe {tmp_path / path} --out {tmp_path / 'd'} --quiet"
        assert told in refused(capsys, command)
