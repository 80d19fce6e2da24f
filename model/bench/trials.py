"""Planning trials: goals, and paths planned, refined, and judged in the truth."""

import math
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from lidarsim.grid import Field, Floats, GridSpec, Ints, Mask
from scenegen.model.bench.planner import Lattice, Plan, checked, plan_path, refine
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import PlanConfig

SAMPLE_M = 0.05
"""Longest gap between the points at which a path is judged, metres (ours)."""


class Trials(NamedTuple):
    """The valid trials of one map, and how many draws were not."""

    goals: Floats
    """(m, 3): points of lattice nodes, map frame, metres."""
    excluded: Counter[str]
    """Goals drawn and not kept, by reason. A blocked start excludes as many as were asked for."""


def draw_trials(
    occupancy_truth: Mask,
    grid: GridSpec,
    config: PlanConfig,
    *,
    count: int,
    rng: np.random.Generator,
    bounds: ArrayLike | None = None,
) -> Trials:
    """Draw goals without replacement from the lattice's outermost layer.

    The layer is ours; the paper has goals "near the map boundary". A goal counts when A* finds a
    path to it in the truth; "cases where no feasible solution is found using the ground-truth map
    are excluded" (the paper's section "Planning with Predicted Distance Fields"), and counted here.

    Args:
        occupancy_truth: True occupancy (*grid.shape).
        grid: The grid.
        config: The planner.
        count: How many goals; fewer if there are not as many.
        rng: Random numbers.
        bounds: Corners of the world in the map frame, (2, 3), metres; goals lie between them.

    Returns:
        The goals, and how many draws were excluded.
    """
    truth = checked(occupancy_truth, "occupancy_truth", grid, bool)
    lattice = Lattice(grid, config.step_voxels)
    if truth[tuple(lattice.voxels(lattice.start))]:
        return Trials(np.empty((0, 3)), Counter({"start_blocked": count}))
    candidates = lattice.centres(boundary_nodes(lattice))
    if bounds is not None:
        low, high = np.asarray(bounds, float)
        candidates = candidates[((candidates >= low) & (candidates <= high)).all(axis=1)]
    goals: list[Floats] = []
    excluded = Counter[str]()
    # goals depend on the truth and not on a method, so all methods have the same trials
    for goal in candidates[rng.permutation(len(candidates))]:
        if len(goals) == count:
            break
        if (reason := plan_path(truth, goal, grid, config).reason) is None:
            goals.append(goal)
        else:
            excluded[reason] += 1
    return Trials(np.array(goals).reshape(-1, 3), excluded)


def boundary_nodes(lattice: Lattice) -> Ints:
    """Nodes (n, 3) of the outermost layer, in order; never the start."""
    nodes = np.indices(tuple(lattice.shape)).reshape(3, -1).T
    outer = (nodes == 0) | (nodes == lattice.shape - 1)
    return nodes[outer.any(axis=1) & (nodes != lattice.start).any(axis=1)]


RATHER = 0.5
"""A voxel of a greater probability is rather occupied than not."""


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """Result of a trial. Lengths and clearances are NaN where no path was found."""

    success: bool
    """A path was found, and no point of it, sampled every `SAMPLE_M`, lies in an occupied voxel of
    the truth."""
    length_m: float = math.nan
    """Length of the refined path, metres."""
    min_clearance_m: float = math.nan
    """Least value of the truth's TUDF at those points, metres: "Euclidean distance to the nearest
    obstacle using the ground-truth TUDF ... along each trajectory" (the paper), to voxel centres
    and at most the truncation."""
    mean_clearance_m: float = math.nan
    """Its mean along the path's length (trapezoidal rule between the points), metres."""
    cause: str | None = None
    """Why the trial failed; None for a success. `start_blocked`, `goal_blocked` and `no_path` are
    the predicted map's; `initial_collides`: A*'s path, too, meets an occupied voxel of the truth;
    `refined_into_obstacle`: it does not."""
    hits: tuple[int, ...] = ()
    """The occupied voxels of the truth that the refined path meets, counted in C order, each once,
    in the order of the path."""
    line_blocked: bool = False
    """Whether the straight line from start to goal meets an occupied voxel of the truth. The bench
    sets this field and the next two."""
    hits_obstacle: bool = False
    """Whether one of `hits` is known to be occupied: in a map of a real place, unknown voxels are
    occupied in the truth of paths, too."""
    hits_crossed_only: bool = False
    """Whether a ray crossed every obstacle voxel among `hits`. The sensor saw these voxels to be
    free; they are occupied because a surface cuts a part of them off."""

    @property
    def hit(self) -> int | None:
        """The first of `hits`; None without any."""
        return self.hits[0] if self.hits else None


def run_trial(
    occupied_pred: Mask,
    tudf_pred: Field,
    occupancy_truth: Mask,
    tudf_truth: Field,
    goal: ArrayLike,
    grid: GridSpec,
    config: PlanConfig,
    risk: Field | None = None,
) -> Measurement:
    """Plan on predicted maps, and judge in the truth.

    The paper's section "Planning with Predicted Distance Fields".

    Args:
        occupied_pred: Predicted occupancy (*grid.shape).
        tudf_pred: Predicted distances (*grid.shape), metres.
        occupancy_truth: True occupancy (*grid.shape).
        tudf_truth: True distances (*grid.shape), metres.
        goal: Point of a lattice node (3,), map frame, metres.
        grid: The grid.
        config: The planner.
        risk: See `plan_trial`.

    Returns:
        The measurement.
    """
    planned = plan_trial(occupied_pred, tudf_pred, risk, goal, grid, config)
    return judge(*planned, occupancy_truth, tudf_truth, grid)


def plan_trial(
    occupied: Mask,
    tudf: Field,
    risk: Field | None,
    goal: ArrayLike,
    grid: GridSpec,
    config: PlanConfig,
) -> tuple[Plan, Floats | None]:
    """Plan on predicted maps: A*, then refinement.

    For the careful planner, edges must be free in A*, too, and the start's own voxel always is, for
    a robot is there. It uses A*'s path unrefined if the refined one meets an occupied voxel that
    A*'s does not. With a risk, A* weighs ways by it, and its path is also used if the refined one
    meets another voxel that is rather occupied than not.

    Args:
        occupied: Collision map (*grid.shape).
        tudf: Distances for the refinement (*grid.shape), metres.
        risk: Probability of meeting something in each voxel (*grid.shape), or None.
        goal: Point of a lattice node (3,), map frame, metres.
        grid: The grid.
        config: The planner.

    Returns:
        The plan of A*, and the refined path (n, 3), map frame, metres; None without a path.
    """
    plan = plan_path(occupied, goal, grid, config, risk)
    if plan.waypoints is None:
        return plan, None
    path = refine(plan.waypoints, tudf, grid, config)
    if config.planner == "careful":
        avoided = occupied if risk is None else occupied | (risk > RATHER)
        # only voxels that the refinement added: A* may have had to pass the others
        entered = np.setdiff1d(met(path, grid), met(plan.waypoints, grid), assume_unique=True)
        if avoided.reshape(-1)[entered].any():
            return plan, plan.waypoints
    return plan, path


def judge(
    plan: Plan,
    refined: Floats | None,
    occupancy_truth: Mask,
    tudf_truth: Field,
    grid: GridSpec,
) -> Measurement:
    """Judge a path in the truth, see `run_trial`.

    Args:
        plan: From `plan_path`.
        refined: The path (n, 3) that was made of it, map frame, metres.
        occupancy_truth: True occupancy (*grid.shape).
        tudf_truth: True distances (*grid.shape), metres.
        grid: The grid.

    Returns:
        The measurement.

    Raises:
        ValueError: The path leaves the map, beyond which there is no truth.
    """
    initial, reason = plan
    if initial is None or refined is None:
        return Measurement(success=False, cause=reason)
    half = grid.extent_m / 2
    if not (np.abs(refined - half) <= half + 1e-5).all():  # less is rounding, in 32 bits too
        raise ValueError(f"the path leaves the map, expected points from 0 to {2 * half} m")
    truth = checked(occupancy_truth, "occupancy_truth", grid, bool).reshape(-1)
    distance = checked(tudf_truth, "tudf_truth", grid, np.float32)
    points, gaps = stations(refined)
    voxels = voxels_of(points, grid)
    met_m = map_coordinates(distance, points.T / grid.voxel_m - 0.5, np.float64, 1, mode="nearest")
    length_m = float(gaps.sum())
    hits = tuple(dict.fromkeys(voxels[truth[voxels]].tolist()))
    # A*'s path tells which to blame: the predicted map, or the refinement
    cause = None
    if hits:
        collides = truth[met(initial, grid)].any()
        cause = "initial_collides" if collides else "refined_into_obstacle"
    return Measurement(
        success=cause is None,
        length_m=length_m,
        min_clearance_m=float(met_m.min()),
        mean_clearance_m=float(gaps @ (met_m[1:] + met_m[:-1]) / 2 / length_m),
        cause=cause,
        hits=hits,
    )


def line_blocked(
    occupancy_truth: Mask, goal: ArrayLike, grid: GridSpec, config: PlanConfig
) -> bool:
    """Check if the straight line from the start to a goal meets an occupied voxel of the truth.

    The rule is that of `Measurement.success`.

    Args:
        occupancy_truth: True occupancy (*grid.shape).
        goal: (3,), map frame, metres.
        grid: The grid.
        config: The planner.

    Returns:
        True if it meets one.
    """
    lattice = Lattice(grid, config.step_voxels)
    line = np.stack([lattice.centres(lattice.start), np.asarray(goal, float)])
    return bool(occupancy_truth.reshape(-1)[met(line, grid)].any())


def stations(path: Floats) -> tuple[Floats, Floats]:
    """Return the points at which a path (n, 3) is judged.

    Returns:
        Its waypoints and, between two, equally spaced ones at most `SAMPLE_M` apart, (m, 3); and
        the gaps between them, (m - 1,), metres.
    """
    legs = np.diff(path, axis=0)
    reach = np.linalg.norm(legs, axis=1)
    # a gap of just `SAMPLE_M` is not split for a rounding error
    pieces = np.maximum(np.ceil(reach / SAMPLE_M - 1e-9), 1).astype(np.int64)
    parts = [
        path[n] + legs[n] * (np.arange(1, count + 1) / count)[:, None]
        for n, count in enumerate(pieces)
    ]
    return np.concatenate([path[:1], *parts]), np.repeat(reach / pieces, pieces)


def voxels_of(points: Floats, grid: GridSpec) -> Ints:
    """Find the voxels that hold points. The map's last faces belong to its last voxels.

    Args:
        points: (m, 3), map frame, metres.
        grid: The grid.

    Returns:
        (m,): numbers in C order.
    """
    index = np.floor(points / grid.voxel_m).astype(np.int64)
    return np.ravel_multi_index(tuple(index.T), grid.shape, mode="clip")


def met(path: Floats, grid: GridSpec) -> Ints:
    """Find the voxels in which a path is judged.

    Args:
        path: (n, 3), map frame, metres.
        grid: The grid.

    Returns:
        Numbers in C order, each once.
    """
    return np.unique(voxels_of(stations(path)[0], grid))


def risk_of(
    prediction: Prediction,
    occupied: Mask,
    seen: Mask,
    config: PlanConfig,
) -> Field:
    """Compute the risk of meeting something in every voxel.

    Args:
        prediction: The prediction.
        occupied: Voxels that count as occupied (*grid.shape); their risk is 1.
        seen: Voxels that a ray reached (*grid.shape); others have at least `config.unseen_risk`.
        config: The planner.

    Returns:
        (*grid.shape): a probability.
    """
    # of a method that predicts distances only, risks where a ray went are 1 and 0
    chance = prediction.occupancy_probability
    risk = np.maximum(occupied, 0 if chance is None else chance, dtype=np.float32)
    return np.where(seen, risk, np.maximum(risk, np.float32(config.unseen_risk)))
