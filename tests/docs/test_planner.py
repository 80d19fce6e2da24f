"""A planner of one's own, as docs/planning.md shows it."""

import numpy as np
import pytest

from scenegen.model.bench.trials import run_trial
from tests.command_line import example
from tests.model.conftest import make_dataset


def test_the_example_judges_as_the_bench_does(tmp_path, monkeypatch):
    make_dataset(tmp_path / "data" / "pillar")
    monkeypatch.chdir(tmp_path)
    ran = {}
    exec(example("planning.md", "def straight"), ran)
    goals = ran["trials"].goals
    assert len(goals) > 3
    start, truth = ran["sample"].position - ran["sample"].origin, ran["truth"]
    lines = [start + (goal - start) * (np.arange(2001)[:, None] / 2000) for goal in goals]
    clear = [
        not ran["sample"].occupancy[tuple((line / ran["grid"].voxel_m).astype(int).T)].any()
        for line in lines
    ]
    maps = ran["occupied"], ran["tudf"], *truth
    assert ran["successes"] == {
        "mine": pytest.approx(
            sum(clear), abs=1
        ),  # a line may touch a voxel between two of the judge's points
        "bench": sum(run_trial(*maps, goal, ran["grid"], ran["config"]).success for goal in goals),
    }
