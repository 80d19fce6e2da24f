"""A recipe that cannot be is refused in one line."""

import os

import pytest

from tests.refusals import refuses_command
from tests.scenegen import cases

DRAWS = "accept.max_draws = 10000\n[flight]\nflights_per_world = 1000\niterations = 1000000"
LARGE = [
    f"grid.voxel_m = {'9' * 9000}",
    f"grid.shape = {'[' * 5000}{']' * 5000}",
    f"{'a.' * 30_000}a = 1",
    f"kind = 'pillar' # {'x' * (1 << 16)}",
    DRAWS,
    "grid.shape = [400, 400, 400]\nflight.viewpoints = 17",
]


@pytest.mark.parametrize(
    "text", [*sum(cases("cli/bad_recipes"), ()), *LARGE], ids=lambda text: text[:30]
)
def test_a_bad_recipe_ends_in_one_line(text, tmp_path, capsys):
    (tmp_path / "r.toml").write_text(text)
    command = f"generate pillar --recipe {tmp_path / 'r.toml'} --n 5 --quiet --out {tmp_path / 'd'}"
    refuses_command(capsys, command, text[:60])


def test_a_recipe_that_is_no_file_ends_in_one_line(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.toml")
    for path in ("pipe.toml", "gone.toml"):
        refuses_command(capsys, f"generate --recipe {tmp_path}/{path} --out {tmp_path}/d --quiet")
