"""A planner of one's own, as docs/examples shows it."""

import numpy as np
import pytest

from scenegen.model.bench.trials import run_trial
from tests.command_line import page
from tests.model.conftest import make_dataset


def test_the_example_judges_as_the_bench_does(tmp_path, monkeypatch):
    make_dataset(tmp_path / "data" / "pillar")
    monkeypatch.chdir(tmp_path)
    ran = {}
    exec(page("examples/my_planner.py"), ran)
    goals, grid, occupancy = ran["trials"].goals, ran["grid"], ran["sample"].occupancy
    assert len(goals) > 3
    start = ran["sample"].position - ran["sample"].origin
    along = np.arange(2001)[:, None] / 2000
    lines = [grid.index(start + (goal - start) * along, 0) for goal in goals]
    clear = sum(not occupancy[tuple(line.T)].any() for line in lines)
    maps = ran["occupied"], ran["tudf"], *ran["truth"]
    expected = sum(run_trial(*maps, goal, grid, ran["config"]).success for goal in goals)
    # a line may touch a voxel between two of the judge's points
    assert ran["successes"] == {"mine": pytest.approx(clear, abs=1), "bench": expected}
