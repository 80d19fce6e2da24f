"""A planner for which risk is one number: it plans where bounds say that space is free, and
abstains elsewhere."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import GridSpec
from scenegen.model.evaluation.config import PlanConfig
from scenegen.model.evaluation.planning.astar import Plan, plan_path
from scenegen.model.evaluation.planning.measure import Measurement, judge, met
from scenegen.model.evaluation.planning.refine import refine


class Careful(NamedTuple):
    """A path that a careful planner made."""

    plan: Plan
    """What A* found; no path where the planner abstains."""
    path: NDArray[np.float64] | None
    """(n, 3): refined, map frame, metres."""
    voxels: NDArray[np.int64]
    """Those that it meets, counted in C order, each once."""

    def judged(
        self,
        occupancy_truth: NDArray[np.bool_],
        tudf_truth: NDArray[np.floating],
        grid: GridSpec,
        config: PlanConfig,
    ) -> Measurement:
        """The path in the truth; see `judge`."""
        return judge(self.plan, self.path, occupancy_truth, tudf_truth, grid, config)


def plan_carefully(
    blocked: NDArray[np.bool_],
    field: NDArray[np.floating],
    goal: ArrayLike,
    grid: GridSpec,
    config: PlanConfig,
) -> Careful:
    """Plan to `goal` (3,), a node's point, through voxels that are not `blocked` (*grid.shape), and
    refine on `field` (*grid.shape), metres.

    The planner keeps to what it knows: A* asks that edges be free, too; the start's own voxel is,
    for a robot is there; and where the refined path meets a blocked voxel that A*'s does not, A*'s
    stands. With bounds of a risk (`Prediction.low`), a voxel is blocked where its bound is 0, and
    the bounds are the field.
    """
    plan = plan_path(
        blocked, goal, grid, dataclasses.replace(config, edge_check=True, free_start=True)
    )
    if plan.waypoints is None:
        return Careful(plan, None, np.empty(0, np.int64))
    path = refine(plan.waypoints, field, grid, config)
    voxels, allowed = met(path, grid, config), met(plan.waypoints, grid, config)
    if blocked.reshape(-1)[np.setdiff1d(voxels, allowed, assume_unique=True)].any():
        return Careful(plan, plan.waypoints, allowed)
    return Careful(plan, path, voxels)
