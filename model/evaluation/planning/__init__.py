"""What a map is worth: a path planned on it, refined on it, and measured in the truth.

All coordinates here are in the map frame: metres from the grid's least corner, axes as the world's.
"""

from scenegen.model.evaluation.planning.astar import Plan, plan_path
from scenegen.model.evaluation.planning.config import PlanConfig
from scenegen.model.evaluation.planning.measure import Measurement, run_trial
from scenegen.model.evaluation.planning.refine import refine
from scenegen.model.evaluation.planning.trials import Trials, draw_trials

__all__ = ["Measurement", "Plan", "PlanConfig", "Trials", "draw_trials", "plan_path", "refine", "run_trial"]
