"""Sensors, noise and engines as the docs show them, run as a user would: files in a folder of their
own, and the command."""

import re
import shutil

import pytest

from tests.command_line import example, page
from tests.refusals import refuses_command
from tests.scenegen import each_case

FILES = {
    "sensor.md": "my_lidar.toml my_rays.toml my.toml",
    "noise.md": "my_noise.py",
    "simulation.md": "make.py",
}
"""What the pages show."""
SMALL = """petals = 5.7
rays = 300

[grid]
shape = [24, 24, 16]

[world]
size_m = [16.0, 16.0, 8.0]

[flight]
viewpoints = 3
margin_m = 2.0
min_distance_m = 4.0
"""
"""What makes the documented recipe small."""


@pytest.fixture
def examples(tmp_path):
    """A folder with the documented files."""
    for shown, names in FILES.items():
        assert re.findall(r"```\w+\n# (\S+)\n", page(shown)) == names.split()
        for name in names.split():
            text = example(shown, f"# {name}\n").replace("petals = 5.7\n", SMALL)
            (tmp_path / name).write_text(text, encoding="utf-8")
    for name in ("my_sensor.py", "my_engine.py"):
        (tmp_path / name).write_text(page(f"examples/{name}"), encoding="utf-8")
    return tmp_path


def test_a_users_sensor_makes_a_dataset_that_nobody_needs_the_sensor_for(examples, shell):
    made = "--n 6 --val 0 --test 3 --shard-samples 3"
    words = f"generate --recipe my.toml {made} --out data/rosette --workers 2"
    shell.done(*words.split(), here=examples)
    (elsewhere := examples / "elsewhere").mkdir()
    shutil.move(examples / "data", elsewhere / "data")
    (elsewhere / "print_one.py").write_text(
        "import scenegen; sample = scenegen.load('data/rosette')[1]; print(sample.ranges.shape, "
        "sample.free.any())"
    )
    assert shell.python("print_one.py", here=elsewhere).out == "(300,) True\n"
    assert "regenerated  ok" in shell.done("verify", "data/rosette", "--workers", 1, here=elsewhere)
    publish = "publish data/rosette --repo a/b --out out --dry-run --workers 1"
    assert "rays.npy" in shell.done(*publish.split(), here=elsewhere)
    again = f"generate --like dataset.json --out {elsewhere}/again --workers 1"
    shell.done(*again.split(), here=elsewhere / "out")
    one, other = (elsewhere / name / "dataset.json" for name in ("again", "out"))
    assert one.read_bytes() == other.read_bytes()


@each_case("../own_sensor", "file find put")
@pytest.mark.usefixtures("standing")
def test_a_sensor_that_is_none_is_told_of_in_one_line(examples, capsys, file, find, put):
    text = (examples / file).read_text()
    assert find in text
    (examples / file).write_text(text.replace(find, put))
    refuses_command(capsys, "generate --recipe my.toml --n 3 --quiet", put)


def test_a_users_engine_makes_a_dataset_that_verify_audits_with_mujoco(examples, shell):
    assert re.fullmatch(r"[0-9a-f]{64}\n", shell.python("make.py", here=examples).out)
    (examples / "my_engine.py").unlink()
    told = shell.done("verify", "data/slow", here=examples)
    assert re.search(r"rays +ok", told)
    assert re.search(r"regenerated +skipped .*made with the engine 'my_engine:OneByOne'", told)
