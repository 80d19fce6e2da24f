"""Methods that draw and that remember: the files of docs/examples, and what robots show."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from scenegen import Completer, Dataset
from scenegen.fly.course import Course
from scenegen.model.inputs import channels
from scenegen.model.robots.flights import robot_maker
from tests.command_line import ROOT, done
from tests.model.conftest import saved_network
from tests.model.training.runs import figures
from tests.refusals import refuses_command

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def here(folders, standing, monkeypatch):
    """A user's folder with the examples, to stand in."""
    monkeypatch.syspath_prepend(standing)
    for path in (ROOT / "docs" / "examples").glob("*.py"):
        assert len(path.read_text().splitlines()) <= 60
        shutil.copy(path, standing)
    (standing / "data").symlink_to(folders[0])
    return standing


def bench(capsys, words):
    """The rows of reconstruction."""
    done(capsys, f"bench data --quick --quiet {words}")
    (rows,) = json.loads(Path("bench/report.json").read_text())["reconstruction"].values()
    return rows


def test_a_diffusion_learns_and_draws(here, capsys):
    own = "my_diffusion:Denoiser"
    done(capsys, f"train data --variant {own} --width 4 --epochs 6 --lr 0.01 --device cpu -o run")
    losses = [float(row["train_entropy"]) for row in figures(Path("run"))]
    assert losses[-1] < 0.7 * losses[0]
    row = bench(capsys, f"--weights {own}@run --method empty --draws 3 --workers 2")["run"]
    assert row["rmse"]["mean"] >= row["best_of_draws"]["rmse"]["mean"]
    completer, split = Completer.from_pretrained(f"{own}@run"), Dataset(here / "data").split("test")
    first, again, other = (
        completer(split[0], rng=np.random.default_rng(seed)).occupancy_probability
        for seed in (1, 1, 2)
    )
    assert_array_equal(first, again)
    assert (first != other).any()
    refuses_command(capsys, f"export {own}@run -o net.onnx")


def test_a_memory_of_one_scan_is_that_scan(here, capsys):
    rows = bench(capsys, "--method my_memory:Remembering --method extrude --workers 1")
    assert rows["remembering"] == rows["extrude"]


def flown(robot, count):
    """A robot after some decisions."""
    flying = Course(world="pillar", flights=1, seed=2).simulation(0)
    robot.reset(flying.about())
    for _ in range(count):
        flying.step(np.float32(robot.act(flying.observe())))
    return robot


def test_a_memory_of_scans_moves_with_the_map_and_ends_with_the_flight(here):
    from my_memory import Robot

    robot = flown(Robot(), 12)
    memory = robot._completer
    assert (memory.evidence > 1.5).any()  # seen more than once, in one place
    unseen = ~(robot.observed | robot.free)
    assert memory.evidence[unseen].any()
    assert memory.evidence[~unseen].any()
    robot.reset(robot._about)
    assert memory.evidence is None


INPUT = """
import numpy as np
def reach(seen, grid, lidar):
    z = seen.origin[2] - seen.position[2] + np.arange(grid.shape[2]) * grid.voxel_m
    return np.broadcast_to(z / lidar.max_range_m, grid.shape) + 0.0 * seen.quaternion[0]
"""


def test_a_robot_shows_a_network_any_input(here):
    (here / "my_input.py").write_text(INPUT)
    inputs, grid = ("distance", "my_input:reach", "observed"), Dataset(here / "data").grid
    saved_network(here / "net.safetensors", grid, inputs=inputs)
    robot = robot_maker("returns", "my_input:reach@net.safetensors")(None)
    shown, network = [], robot._completer

    class Spy:
        def complete(self, observed, free, *, grid, seen, rng):
            shown.append(seen)
            return network.complete(observed, free, grid=grid, seen=seen, rng=rng)

    robot._completer = Spy()
    flown(robot, 2)
    seen = shown[-1]
    maps = channels(inputs, seen, grid, seen.lidar)
    assert_array_equal(maps["observed"], robot.observed)
    below = maps["my_input:reach"][0, 0] < 0
    assert below[0]
    assert not below[-1]
