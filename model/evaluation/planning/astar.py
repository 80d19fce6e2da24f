"""A* on a lattice of voxel centres: the shortest path on a collision map."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import Field, Floats, GridSpec, Ints, Mask
from scenegen.model.config import PlanConfig
from scenegen.truth.search import NO_RISK, search


class Plan(NamedTuple):
    """What a search gave: a path, or why there is none."""

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
        """The node (3,) whose point is `point` (3,). Raises ValueError where there is none within
        1e-6 m."""
        point = np.asarray(point, float)
        if point.shape == (3,) and np.isfinite(point).all():
            steps = (point / self.grid.voxel_m - 0.5 - self.first) / self.step
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
    """The shortest path through free nodes from the map's middle to `goal` (3,), a node's point,
    map frame, metres.

    `occupied` (*grid.shape) is the binary collision map. A node is free when its voxel is; every
    node has up to 26 neighbours, as far away as they are in space (the paper's section "Planning
    Evaluation", and `Lattice`). With `config.edge_check`, and for the careful planner, the voxels
    that the segment between two nodes meets with positive length must be free, too; for the careful
    planner the start's own voxel need not be. The answer is exact, and the same on every run: of
    two equally long ways to a node the first found stands, and of two nodes equally far by length
    and estimate the farther from the start, then the lower number, comes first.

    With `risk` (*grid.shape), probabilities, an edge is longer by `config.risk_weight` times its
    length times the mean risk of the voxels stepped on from node to node, the first left out.

    Raises ValueError where `goal` is no node or the map's shape is not the grid's.
    """
    occupied = checked(occupied, "occupied", grid, bool)
    lattice = Lattice(grid, config.step_voxels)
    start, end = lattice.start, lattice.node_at(goal)
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
    """`values` as a contiguous array of `dtype`. Raises ValueError where its shape is not the
    grid's."""
    values = np.ascontiguousarray(values, dtype)
    if values.shape != grid.shape:
        raise ValueError(f"{name}: shape {values.shape} must be the grid's, {grid.shape}")
    return values
