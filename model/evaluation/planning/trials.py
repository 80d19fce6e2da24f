"""Planning trials: goals near a map's boundary that can be reached in the truth."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import GridSpec
from scenegen.model.evaluation.config import PlanConfig
from scenegen.model.evaluation.planning.astar import Blocked, Lattice, checked, plan_path


@dataclass(frozen=True, eq=False)
class Trials:
    """The valid trials of one map, and how many draws were not."""

    goals: NDArray[np.float64]
    """(m, 3): points of lattice nodes, map frame, metres."""
    excluded: Counter[Blocked] = field(default_factory=Counter)
    """Goals drawn and not kept, by reason. A blocked start excludes as many as were asked for."""


def draw_trials(
    occupancy_truth: NDArray[np.bool_],
    grid: GridSpec,
    config: PlanConfig,
    *,
    count: int,
    rng: np.random.Generator,
    bounds: ArrayLike | None = None,
) -> Trials:
    """`count` goals, or as many as there are, drawn without replacement from the lattice's
    outermost layer.

    The layer is that of `config.goal_faces`, less the nodes outside `bounds` (2, 3), least and
    greatest corner in the map frame, metres, where given: the world's, so that goals lie in it. A
    goal counts when A* finds a path to it in `occupancy_truth` (*grid.shape); "cases where no
    feasible solution is found using the ground-truth map are excluded" (the paper's section
    "Planning with Predicted Distance Fields"), and counted here.
    """
    truth = checked(occupancy_truth, "occupancy_truth", grid, np.bool_)
    lattice = Lattice(grid, config.step_voxels)
    if truth[tuple(lattice.voxels(lattice.start))]:
        return Trials(np.empty((0, 3)), Counter({"start_blocked": count}))
    candidates = lattice.centres(boundary_nodes(lattice, config.goal_faces))
    if bounds is not None:
        low, high = np.asarray(bounds, dtype=np.float64)
        candidates = candidates[((candidates >= low) & (candidates <= high)).all(axis=1)]
    goals: list[NDArray[np.float64]] = []
    excluded: Counter[Blocked] = Counter()
    for goal in candidates[rng.permutation(len(candidates))]:
        if len(goals) == count:
            break
        _, reason = plan_path(truth, goal, grid, config)
        if reason is None:
            goals.append(goal)
        else:
            excluded[reason] += 1
    return Trials(np.array(goals).reshape(-1, 3), excluded)


def boundary_nodes(lattice: Lattice, faces: str) -> NDArray[np.int64]:
    """Nodes (n, 3) of the outermost layer in x or y ("lateral"), or in z, too ("box"), in order;
    never the start."""
    nodes = np.indices(lattice.shape).reshape(3, -1).T
    axes = 2 if faces == "lateral" else 3
    outer = (nodes == 0) | (nodes == np.array(lattice.shape) - 1)
    return nodes[outer[:, :axes].any(axis=1) & (nodes != lattice.start).any(axis=1)]
