"""What a map is worth: a path planned on it, refined on it, and measured in the truth.

All coordinates here are in the map frame: metres from the grid's least corner, axes as the world's.
"""

from model.planning.astar import Plan, plan_path
from model.planning.config import PlanConfig
from model.planning.measure import Measurement, run_trial
from model.planning.refine import refine
from model.planning.trials import Trials, draw_trials

__all__ = ["Measurement", "Plan", "PlanConfig", "Trials", "draw_trials", "plan_path", "refine", "run_trial"]
