"""The planner: A* on a lattice of voxel centres gives the shortest path on a collision map;
gradient descent then smooths it, and pushes it away from obstacles by a distance field."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import Field, Floats, GridSpec, Ints, Mask
from lidarsim.jit import kernel
from scenegen.model.config import PlanConfig
from scenegen.truth.difficulty import NO_RISK, search


class Plan(NamedTuple):
    """Result of a search: a path, or the reason why there is none."""

    waypoints: Floats | None
    """(n, 3): from the start to the goal, a node each, map frame, metres."""
    reason: str | None
    """`start_blocked`, `goal_blocked` or `no_path`; None where there is a path."""


@dataclass(frozen=True)
class Lattice:
    """Every `step`-th voxel of a grid in each direction, counted from the middle one, shape // 2,
    where paths start.

    Nodes are numbered (a, b, c) from the least corner. The paper's "step size" of 0.6 m at the
    default grid gives 27 x 27 x 13 nodes.
    """

    grid: GridSpec
    step: int
    """Voxels from node to node."""

    @property
    def first(self) -> Ints:
        """Voxel (3,) of node (0, 0, 0)."""
        return np.array(self.grid.shape) // 2 % self.step

    @property
    def shape(self) -> Ints:
        """Nodes (3,) along x, y and z."""
        return 1 + (np.array(self.grid.shape) - 1 - self.first) // self.step

    @property
    def start(self) -> Ints:
        """The start's node (3,): its voxel is shape // 2, whose least corner is the middle of an
        even grid."""
        return np.array(self.grid.shape) // 2 // self.step

    def voxels(self, nodes: ArrayLike) -> Ints:
        """Voxels (..., 3) of `nodes` (..., 3)."""
        return self.first + self.step * np.asarray(nodes, np.int64)

    def centres(self, nodes: ArrayLike) -> Floats:
        """Points (..., 3) of `nodes` (..., 3): their voxels' centres, map frame, metres."""
        return np.asarray((self.voxels(nodes) + 0.5) * self.grid.voxel_m)

    def node_at(self, point: ArrayLike) -> Ints:
        """Find the node at a point.

        Args:
            point: (3,), map frame, metres.

        Returns:
            The node (3,).

        Raises:
            ValueError: There is none within 1e-6 m.
        """
        point = np.asarray(point, float)
        if point.shape == (3,) and np.isfinite(point).all():
            steps = (point / self.grid.voxel_m - 0.5 - self.first) / self.step
            # a point beside a node would be moved in silence, and the path end elsewhere
            node = np.rint(steps).astype(np.int64)
            inside = ((node >= 0) & (node < self.shape)).all()
            if inside and np.abs(self.centres(node) - point).max() <= 1e-6:
                return node
        raise ValueError(
            f"goal = {point.tolist()} is no node of the lattice: expected the centre of a voxel "
            f"that lies a multiple of {self.step} voxels from "
            f"{[n // 2 for n in self.grid.shape]} within {self.grid.shape}, map frame, metres"
        )


def plan_path(
    occupied: Mask,
    goal: ArrayLike,
    grid: GridSpec,
    config: PlanConfig,
    risk: Field | None = None,
) -> Plan:
    """Find the shortest path through free nodes from the map's middle to a goal.

    A node is free when its voxel is. Every node has up to 26 neighbours, as far away as they are in
    space (the paper's section "Planning Evaluation", and `Lattice`). With `config.edge_check`, and
    for the careful planner, the voxels that the segment between two nodes meets with positive
    length must be free, too. For the careful planner the start's own voxel need not be.

    The answer is exact, and the same on every run: of two equally long ways to a node the first
    stands, and of two nodes equally far by length and estimate the farther from the start, then the
    lower number, comes first.

    Args:
        occupied: Binary collision map (*grid.shape).
        goal: Point of a node (3,), map frame, metres.
        grid: The grid.
        config: The planner.
        risk: Probabilities (*grid.shape). An edge is longer by `config.risk_weight` times its
            length times the mean risk of the voxels stepped on from node to node, without the
            first.

    Returns:
        The path, or the reason why there is none.

    Raises:
        ValueError: `goal` is not a node, or a map's shape is not the grid's.
    """
    occupied = checked(occupied, "occupied", grid, bool)
    lattice = Lattice(grid, config.step_voxels)
    start, end = lattice.start, lattice.node_at(goal)
    # a robot is where it is: the careful planner does not let a false obstacle there hold it
    if occupied[tuple(lattice.voxels(start))] and config.planner != "careful":
        return Plan(None, "start_blocked")
    if occupied[tuple(lattice.voxels(end))]:
        return Plan(None, "goal_blocked")
    nodes = search(
        occupied,
        lattice.first,
        lattice.shape,
        lattice.step,
        start,
        end,
        config.edge_check or config.planner == "careful",
        NO_RISK if risk is None else checked(risk, "risk", grid, np.float32),
        config.risk_weight,
    )
    return Plan(lattice.centres(nodes), None) if len(nodes) else Plan(None, "no_path")


def checked(values: NDArray, name: str, grid: GridSpec, dtype: type) -> NDArray:
    """Make an array contiguous and of a type.

    Args:
        values: The array.
        name: Its name, for errors.
        grid: The grid.
        dtype: The type.

    Returns:
        The array, a copy only if it has to be.

    Raises:
        ValueError: Its shape is not the grid's.
    """
    values = np.ascontiguousarray(values, dtype)
    if values.shape != grid.shape:
        raise ValueError(f"{name}: shape {values.shape} must be the grid's, {grid.shape}")
    return values


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
    """Refine a path by gradient descent on `_cost`; its ends stay.

    The paper's section "Planning Evaluation", which does not name the optimizer. Here each of
    `config.iterations` steps is projected onto the box of the map's voxel centres, where the field
    is interpolated and never extrapolated, and shortened until it brings Armijo's decrease, so that
    the cost never rises. Ends early where no step does.

    Args:
        waypoints: The path (n, 3), map frame, metres.
        tudf: Predicted distances (*grid.shape), metres.
        grid: The grid.
        config: The planner.

    Returns:
        The path (n, 3).
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
    """Interpolate a field at a point.

    Args:
        tudf: The field (X, Y, Z), metres.
        x: The point in the map frame, metres.
        y: See `x`.
        z: See `x`.
        voxel_m: Edge of a voxel, metres.

    Returns:
        Value, metres, and gradient: (value, d/dx, d/dy, d/dz).
    """
    # trilinear between the centres of eight voxels, with its exact gradient
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
    # values are those of voxel centres, half a voxel from the faces
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
    # the ends do not move, although the bends beside them pull at them
    slope[0] = 0.0
    slope[-1] = 0.0
    return total


@kernel
def _descend(path, tudf, voxel_m, safety_m, weight, iterations):
    """Projected gradient descent (Bertsekas 1976): a step t to p' must bring ARMIJO / t * |p' -
    p|^2 at least."""
    path = path.copy()
    slope, ahead, trial = np.empty_like(path), np.empty_like(path), path.copy()
    cost = _cost(path, tudf, voxel_m, safety_m, weight, slope)
    step = FIRST_STEP * SHRINK
    for _ in range(iterations):
        # the last step held, so the next may try a longer one
        step /= SHRINK
        while True:
            moved = 0.0
            for i in range(1, len(path) - 1):
                for axis in range(3):
                    # projected, for beyond the outermost centres the field is constant
                    high = (tudf.shape[axis] - 0.5) * voxel_m
                    trial[i, axis] = min(
                        max(path[i, axis] - step * slope[i, axis], 0.5 * voxel_m), high
                    )
                    moved += (trial[i, axis] - path[i, axis]) ** 2
            # a minimum, or every waypoint pressed against the box
            if moved == 0.0:
                return path
            trial_cost = _cost(trial, tudf, voxel_m, safety_m, weight, ahead)
            if trial_cost <= cost - ARMIJO / step * moved:
                break
            step *= SHRINK
            if step < SHORTEST_STEP:
                return path
        # swapped and not copied: no array is allocated in the loop
        path, trial, slope, ahead = trial, path, ahead, slope
        cost = trial_cost
    return path
