"""Planning trials: goals, and paths planned, refined by gradient descent that smooths them and
pushes them away from obstacles, and judged in the truth."""

import math
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from lidarsim.grid import Field, Floats, GridSpec, Ints, Mask
from lidarsim.jit import kernel
from scenegen.model.completion.protocol import Prediction
from scenegen.model.config import PlanConfig
from scenegen.model.evaluation.planning.astar import Lattice, Plan, checked, plan_path

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
    """`count` goals, or as many as there are, drawn without replacement from the lattice's
    outermost layer.

    The layer is ours; the paper has goals "near the map boundary". Nodes outside `bounds` (2, 3),
    least and greatest corner in the map frame, metres, are left out, where these are given: the
    world's, so that goals lie in it. A goal counts when A* finds a path to it in `occupancy_truth`
    (*grid.shape); "cases where no feasible solution is found using the ground-truth map are
    excluded" (the paper's section "Planning with Predicted Distance Fields"), and counted here.
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
    """What a trial gave. Lengths and clearances are NaN where no path was found."""

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
    hit: int | None = None
    """The first occupied voxel of the truth that the refined path meets, counted in C order; None
    for none."""


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
    """Plan to `goal` (3,), a lattice node's point, map frame, metres, on the predicted maps
    (*grid.shape); judge in the truth (*grid.shape). Distances are metres. The paper's section
    "Planning with Predicted Distance Fields"; `plan_trial` says what `risk` is."""
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
    """What A* finds to `goal` (3,), a node's point, through voxels that are not `occupied`
    (*grid.shape), and the path (n, 3) that is made of it by refinement on `tudf` (*grid.shape),
    metres.

    The careful planner keeps to what it knows: A* asks that edges be free, too; the start's own
    voxel is, for a robot is there; and where the refined path meets an occupied voxel that A*'s
    does not, A*'s stands. With bounds of a risk (`Prediction.low`), a voxel is occupied where its
    bound is 0, and the bounds are the distances. With the `risk` (*grid.shape) of meeting
    something, a probability, A* weighs ways by it, and its path stands, too, where the refined one
    meets another voxel that is rather occupied than not.
    """
    plan = plan_path(occupied, goal, grid, config, risk)
    if plan.waypoints is None:
        return plan, None
    path = refine(plan.waypoints, tudf, grid, config)
    if config.planner == "careful":
        avoided = occupied if risk is None else occupied | (risk > RATHER)
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
    """Judge in the truth the path `refined` (n, 3) that was made of what `plan_path` gave; see
    `run_trial`. Raises ValueError where the path leaves the map, of which the truth says
    nothing beyond."""
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
    hits = voxels[truth[voxels]]
    cause = None
    if len(hits):
        collides = truth[met(initial, grid)].any()
        cause = "initial_collides" if collides else "refined_into_obstacle"
    return Measurement(
        success=cause is None,
        length_m=length_m,
        min_clearance_m=float(met_m.min()),
        mean_clearance_m=float(gaps @ (met_m[1:] + met_m[:-1]) / 2 / length_m),
        cause=cause,
        hit=int(hits[0]) if len(hits) else None,
    )


def stations(path: Floats) -> tuple[Floats, Floats]:
    """The points (m, 3) at which a path (n, 3) is judged: its waypoints and, between two, equally
    spaced ones at most `SAMPLE_M` apart; and the gaps (m - 1,) between them, metres."""
    legs = np.diff(path, axis=0)
    reach = np.linalg.norm(legs, axis=1)
    pieces = np.maximum(np.ceil(reach / SAMPLE_M - 1e-9), 1).astype(np.int64)
    parts = [
        path[n] + legs[n] * (np.arange(1, count + 1) / count)[:, None]
        for n, count in enumerate(pieces)
    ]
    return np.concatenate([path[:1], *parts]), np.repeat(reach / pieces, pieces)


def voxels_of(points: Floats, grid: GridSpec) -> Ints:
    """The voxels (m,) that hold points (m, 3) of the map, counted in C order. The map's last faces
    belong to its last voxels."""
    index = np.floor(points / grid.voxel_m).astype(np.int64)
    return np.ravel_multi_index(tuple(index.T), grid.shape, mode="clip")


def met(path: Floats, grid: GridSpec) -> Ints:
    """The voxels, counted in C order, each once, that hold the points at which a path (n, 3) is
    judged."""
    return np.unique(voxels_of(stations(path)[0], grid))


def risk_of(
    said: Prediction,
    occupied: Mask,
    seen: Mask,
    config: PlanConfig,
) -> Field:
    """The risk of meeting something in every voxel (*grid.shape), a probability: 1 where it is held
    `occupied`, else what is `said`, and no less than `config.unseen_risk` where it was not
    `seen`."""
    chance = said.occupancy_probability
    risk = np.maximum(occupied, 0 if chance is None else chance, dtype=np.float32)
    return np.where(seen, risk, np.maximum(risk, np.float32(config.unseen_risk)))


FIRST_STEP = 1.0
"""Length of the first step tried, in gradients; later ones begin at the last accepted one,
lengthened."""
SHRINK = 0.5
"""Factor by which a step that is not accepted is shortened, and by whose inverse the next is
lengthened."""
ARMIJO = 0.1
"""Share of the decrease promised by the gradient that a step must bring; small ones let steps
overshoot."""
SHORTEST_STEP = 1e-12
"""Steps shorter than this, in gradients, are not tried: the path stands at a minimum or on a kink
of the field."""


def refine(waypoints: ArrayLike, tudf: Field, grid: GridSpec, config: PlanConfig) -> Floats:
    """The path (n, 3) after gradient descent on `_cost` from `waypoints` (n, 3), map frame, metres;
    ends stay.

    The paper's section "Planning Evaluation", whose optimizer is not told; here each of
    `config.iterations` steps is projected onto the box of the map's voxel centres, where the field
    is interpolated and never extrapolated, and shortened until it brings Armijo's decrease, so that
    the cost never rises. Ends early where no step does.

    `tudf` (*grid.shape) is the predicted distance, metres.
    """
    return _descend(
        np.ascontiguousarray(waypoints, float),
        checked(tudf, "tudf", grid, np.float32),
        grid.voxel_m,
        config.safety_m,
        config.clearance_weight,
        config.iterations,
    )


@kernel
def field_at(tudf, x, y, z, voxel_m):
    """The field at a point of the map, metres, and its gradient there: (value, d/dx, d/dy,
    d/dz)."""
    nx, ny, nz = tudf.shape
    i, u, in_x = _cell(x, voxel_m, nx)
    j, v, in_y = _cell(y, voxel_m, ny)
    k, w, in_z = _cell(z, voxel_m, nz)
    p, q, r = min(i + 1, nx - 1), min(j + 1, ny - 1), min(k + 1, nz - 1)
    a, b = np.float64(tudf[i, j, k]), np.float64(tudf[i, j, r])
    c, d = np.float64(tudf[i, q, k]), np.float64(tudf[i, q, r])
    e, f = np.float64(tudf[p, j, k]), np.float64(tudf[p, j, r])
    g, h = np.float64(tudf[p, q, k]), np.float64(tudf[p, q, r])
    ab, cd, ef, gh = a + w * (b - a), c + w * (d - c), e + w * (f - e), g + w * (h - g)
    low, high = ab + v * (cd - ab), ef + v * (gh - ef)
    by_x = high - low
    by_y = (1.0 - u) * (cd - ab) + u * (gh - ef)
    by_z = (1.0 - u) * ((1.0 - v) * (b - a) + v * (d - c)) + u * ((1.0 - v) * (f - e) + v * (h - g))
    return low + u * by_x, in_x * by_x / voxel_m, in_y * by_y / voxel_m, in_z * by_z / voxel_m


@kernel
def _cell(at, voxel_m, count):
    """The voxel whose centre comes last before `at` along one axis, the way from there to the next
    centre, 0 to 1, and whether (1.0 or 0.0) the field changes with `at`: it does not beyond the
    outermost centres."""
    steps = at / voxel_m - 0.5
    if steps <= 0.0:
        return 0, 0.0, 1.0 if steps == 0.0 else 0.0
    if steps >= count - 1.0:
        last = max(count - 2, 0)
        return last, min(count - 1.0, 1.0), 1.0 if steps == count - 1.0 else 0.0
    whole = int(steps)
    return whole, steps - whole, 1.0


@kernel
def _cost(path, tudf, voxel_m, safety_m, weight, slope):
    """J = sum |p[i+1] - 2 p[i] + p[i-1]|^2 + lambda_c sum max(0, d_s - D(p[i]))^2, m^2, over the
    waypoints between the ends (the paper's section "Planning Evaluation"). D is `field_at`'s.

    Its gradient is written to `slope` (n, 3), metres; 0 at the ends. On a kink of the interpolated
    field, it is that of one side.
    """
    total = 0.0
    slope[:] = 0.0
    for i in range(1, len(path) - 1):
        for axis in range(3):
            bend = path[i + 1, axis] - 2.0 * path[i, axis] + path[i - 1, axis]
            total += bend * bend
            slope[i - 1, axis] += 2.0 * bend
            slope[i, axis] -= 4.0 * bend
            slope[i + 1, axis] += 2.0 * bend
        value, by_x, by_y, by_z = field_at(tudf, path[i, 0], path[i, 1], path[i, 2], voxel_m)
        lack = max(safety_m - value, 0.0)
        total += weight * lack * lack
        push = -2.0 * weight * lack
        slope[i, 0] += push * by_x
        slope[i, 1] += push * by_y
        slope[i, 2] += push * by_z
    slope[0] = 0.0
    slope[-1] = 0.0
    return total


@kernel
def _descend(path, tudf, voxel_m, safety_m, weight, iterations):
    """Projected gradient descent (Bertsekas 1976): a step t to p' must bring ARMIJO / t * |p' -
    p|^2 at least."""
    path = path.copy()
    slope, ahead, trial = np.empty_like(path), np.empty_like(path), path.copy()
    here = _cost(path, tudf, voxel_m, safety_m, weight, slope)
    step = FIRST_STEP * SHRINK
    for _ in range(iterations):
        step /= SHRINK
        while True:
            moved = 0.0
            for i in range(1, len(path) - 1):
                for axis in range(3):
                    high = (tudf.shape[axis] - 0.5) * voxel_m
                    trial[i, axis] = min(
                        max(path[i, axis] - step * slope[i, axis], 0.5 * voxel_m), high
                    )
                    moved += (trial[i, axis] - path[i, axis]) ** 2
            if moved == 0.0:
                return path
            there = _cost(trial, tudf, voxel_m, safety_m, weight, ahead)
            if there <= here - ARMIJO / step * moved:
                break
            step *= SHRINK
            if step < SHORTEST_STEP:
                return path
        path, trial, slope, ahead = trial, path, ahead, slope
        here = there
    return path
