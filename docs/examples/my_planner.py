"""A planner of your own beside the bench's, on goals of one sample."""

import numpy as np

import scenegen
from scenegen.draw.sample import rng_of
from scenegen.model.bench.planner import Plan
from scenegen.model.bench.run import trials_of
from scenegen.model.bench.trials import judge, run_trial
from scenegen.model.bench.visibility import Case
from scenegen.model.completion.protocol import Extrude
from scenegen.model.config import BenchConfig


def straight(occupied, tudf, start, goal, grid):
    """A planner: (n, 3) points from start to goal, map frame, metres; here a straight line."""
    return np.linspace(start, goal, 20)


samples, bench = scenegen.load("data/pillar", split="test"), BenchConfig()
case, config = Case(samples[0], 0, samples), bench.plan
sample, grid, truth = case.sample, case.grid, case.truth
complete = Extrude().complete  # or Completer.from_pretrained().complete, which needs torch
prediction = complete(sample.observed, sample.free, grid=grid)
occupied = prediction.occupied()  # bool (80, 80, 40)
tudf = prediction.distance(None, grid)  # float32 (80, 80, 40), metres; at most 2

trials = trials_of(case, config, 20, rng_of(bench.seed, case.index))
successes = {"mine": 0, "bench": 0}
for goal in trials.goals:
    path = straight(occupied, tudf, sample.position - sample.origin, goal, grid)
    successes["mine"] += judge(Plan(path, None), path, *truth, grid).success
    successes["bench"] += run_trial(occupied, tudf, *truth, goal, grid, config).success
print(successes)
