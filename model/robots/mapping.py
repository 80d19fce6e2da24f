"""A robot that maps: scans are fused in a grid that moves along, completed, and planned through,
ten times a second."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Pose, Scan, voxelize
from lidarsim.pose import rotate
from scenegen.fly.simulation import Observation
from scenegen.model.completion.protocol import MapCompleter
from scenegen.model.config import Thresholds
from scenegen.model.evaluation.config import PlanConfig
from scenegen.model.evaluation.planning.astar import Lattice
from scenegen.model.evaluation.planning.measure import RATHER, risk_of
from scenegen.model.evaluation.planning.refine import field_at, refine
from scenegen.model.robots.steering import follow, no_way
from scenegen.truth import distance_field
from scenegen.worlds.place import Place
from scenegen.worlds.search import search
from scenegen.worlds.world import World

SPARES_M = (0.3, 0.15, 0.0)
"""How much farther than its radius the vehicle's path keeps from occupied voxels' centres, metres:
the first with which there is a path."""
RENEWED_M = 4.0
"""A path that ends nearer, and not at the goal, is planned anew, metres."""
LOOK_M = 1.5
"""How far ahead the vehicle heeds how narrow the way is, metres."""
PLAN = PlanConfig(step_voxels=2, iterations=20)


@dataclass(frozen=True, eq=False)
class _Rays:
    """What of a sensor its robot is told."""

    shape: tuple[int, ...]
    directions_body: NDArray[np.float64]
    times_s: NDArray[np.float64]
    max_range_m: float


class MappingRobot:
    """Fuses scans by visibility in the completer's grid around it, and takes for occupied what
    returned, and what the `completer` says of voxels that no ray crossed.

    A* leads to the goal, or to the map's edge on the way to it; its path is refined as the bench
    does, and followed. Without `memory`, a map is of one scan.
    """

    def __init__(self, completer: MapCompleter, *, memory: bool = True):
        self._completer, self._memory = completer, memory
        self.grid: GridSpec = getattr(completer, "grid", GridSpec())
        self._lattice = Lattice(self.grid, PLAN.step_voxels)

    def reset(self, about: Observation) -> None:
        """See `Robot.reset`."""
        self._about = about
        shape = about["times_s"].shape
        self._rays = _Rays(
            shape, about["directions_body"], about["times_s"], float(about["max_range_m"])
        )
        self._corner: NDArray[np.int64] | None = None
        self._path: NDArray[np.float64] | None = None
        self._last = np.array(self.grid.shape) - 1
        self.observed, self.free = np.zeros((2, *self.grid.shape), np.bool_)

    def act(self, observation: Observation) -> NDArray[np.float64]:
        """See `Robot.act`."""
        self._move(observation["position"])
        self._see(observation)
        occupied, risk = self.believed()
        distance = distance_field(occupied, self.grid)
        path = self._kept(observation, distance)
        if path is None:
            path = self._plan(observation, distance, risk)
            self._path = None if path is None else path + self.origin
        if path is None:
            return no_way(self._about)
        near = path[(np.abs(path - path[0]) <= LOOK_M).all(axis=1)]
        least = min(float(field_at(distance, x, y, z, self.grid.voxel_m)[0]) for x, y, z in near)
        free_m = least - float(self._about["radius_m"])
        return follow(path + self.origin, observation, self._about, free_m)

    def _kept(
        self, observation: Observation, distance: NDArray[np.float32]
    ) -> NDArray[np.float64] | None:
        """What is left of the last path, (n, 3) metres in the map, while it is free, and leads to
        the goal or far enough: else one way out and the next could take turns."""
        if self._path is None:
            return None
        position = observation["position"]
        legs, way = np.diff(self._path, axis=0), position - self._path[:-1]
        lengths = np.maximum((legs * legs).sum(axis=1), 1e-12)
        along = np.clip((way * legs).sum(axis=1) / lengths, 0, 1)
        away = ((way - along[:, None] * legs) ** 2).sum(axis=1)
        left = self._path[int(np.argmin(away)) + 1 :]
        goal = observation["goal"]
        ends = bool(len(left)) and math.dist(left[-1], goal) < 1e-6
        seen = (np.abs(goal - position) < self.grid.extent_m / 2).all()
        far = bool(len(left)) and math.dist(left[-1], position) > RENEWED_M
        if not (ends or (far and not seen)):
            return None
        path = np.concatenate([position[None], left]) - self.origin
        between = np.concatenate([path[1:], 0.5 * (path[1:] + path[:-1])])
        voxels = np.clip(np.floor(between / self.grid.voxel_m).astype(int), 0, self._last)
        free = distance[tuple(voxels.T)] >= self._about["radius_m"]
        return path if free.all() else None

    @property
    def origin(self) -> NDArray[np.float64]:
        """The map's least corner (3,), world metres."""
        assert self._corner is not None
        return self._corner * np.float64(self.grid.voxel_m)

    def believed(self) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """What the robot takes for occupied, and the risk of meeting something, (*grid.shape)
        each."""
        found = self._completer.complete(self.observed, self.free, grid=self.grid)
        at = Thresholds(probability=PLAN.careful_probability)
        occupied = self.observed | (found.occupied(at) & ~self.free)
        return occupied, risk_of(found, occupied, self.observed | self.free, PLAN)

    def _move(self, position: NDArray[np.float64]) -> None:
        """Have the middle voxel hold the vehicle; what leaves the map is forgotten."""
        shape = np.array(self.grid.shape)
        corner = np.floor(position / self.grid.voxel_m).astype(np.int64) - shape // 2
        before, self._corner = self._corner, corner
        if before is None:
            return
        moved = corner - before
        kept = tuple(slice(max(m, 0), n + min(m, 0)) for m, n in zip(moved, shape, strict=True))
        put = tuple(slice(max(-m, 0), n + min(-m, 0)) for m, n in zip(moved, shape, strict=True))
        for name in ("observed", "free"):
            there = np.zeros(self.grid.shape, np.bool_)
            if self._memory and (abs(moved) < shape).all():
                there[put] = getattr(self, name)[kept]
            setattr(self, name, there)

    def _see(self, observation: Observation) -> None:
        quaternion = observation["quaternion"]
        arm = rotate(quaternion, self._about["lever_arm_m"][None])[0]
        pose = Pose(observation["position"] + arm, quaternion)
        seen = voxelize(Scan(observation["ranges"], pose, self._rays), self.grid, self.origin)
        if self._memory:
            self.observed |= seen.observed
            self.free = (self.free | seen.free) & ~self.observed
        else:
            self.observed, self.free = seen.observed, seen.free

    def _plan(
        self,
        observation: Observation,
        distance: NDArray[np.float32],
        risk: NDArray[np.float32],
    ) -> NDArray[np.float64] | None:
        """A path (n, 3) from the vehicle on, metres in the map; `distance` (*grid.shape) is that
        from what is taken for occupied, metres, and `risk` that of meeting something."""
        grid, lattice, about = self.grid, self._lattice, self._about
        goal = observation["goal"] - self.origin
        fence = np.floor((about["bounds"] - self.origin) / grid.voxel_m).astype(np.int64)
        low, high = fence[0] + 1, fence[1]
        beyond = np.ones(grid.shape, np.bool_)
        beyond[tuple(map(slice, np.maximum(low, 0), np.maximum(high, 0)))] = False
        # the goal's node, or the next one within the bounds
        ends = -((lattice.first - low) // lattice.step), (high - 1 - lattice.first) // lattice.step
        node = np.rint((goal / grid.voxel_m - 0.5 - lattice.first) / lattice.step).astype(np.int64)
        node = np.clip(node, *ends)
        inside = bool(((node >= 0) & (node < lattice.shape)).all())
        for spare in SPARES_M:
            blocked = beyond | (distance < float(about["radius_m"]) + spare)
            if inside:
                blocked[tuple(lattice.voxels(node))] = False
            nodes = search(
                blocked,
                lattice.first,
                np.array(lattice.shape),
                lattice.step,
                lattice.start,
                node,
                True,
                risk,
                PLAN.risk_weight,
            )
            if len(nodes):
                break
        else:
            return None
        rough = lattice.centres(nodes)
        path = refine(rough, distance, grid, PLAN) if len(rough) > 2 else rough
        voxels = tuple(np.floor(path[1:] / grid.voxel_m).astype(int).T)
        path = rough if (blocked | (risk > RATHER))[voxels].any() else path
        path[0] = observation["position"] - self.origin
        return np.concatenate([path, goal[None]]) if inside else path


class TruthRobot(MappingRobot):
    """What a robot would do that knew the world: the ceiling of every completion."""

    def __init__(self, world: World | Place):
        self._world = world
        self.grid = GridSpec()
        self._memory = False
        self._lattice = Lattice(self.grid, PLAN.step_voxels)

    def believed(self) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """See `MappingRobot.believed`."""
        truth = self._world.truth(self.grid, self.origin)
        occupied = truth["occupancy"] | ~truth.get("known", np.bool_(True))
        return occupied, occupied.astype(np.float32)

    def _see(self, observation: Observation) -> None:
        """Nothing."""
