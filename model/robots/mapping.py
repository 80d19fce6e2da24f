"""A robot that maps: ten times a second it fuses a scan into a grid that moves along, completes the
grid, and plans a path."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from lidarsim import GridSpec, Pose, Scan, voxelize
from lidarsim.grid import Field, Floats, Ints, Mask
from lidarsim.pose import rotate
from lidarsim.scan import is_return
from scenegen.fly.simulation import Observation
from scenegen.model.bench.planner import field_at, refine
from scenegen.model.bench.trials import RATHER, risk_of
from scenegen.model.completion.protocol import Prediction, ReturnsCompleter, complete_seen, forget
from scenegen.model.config import PlanConfig, Thresholds
from scenegen.model.inputs import SeenMap
from scenegen.model.robots.steering import follow, lag_s, no_way
from scenegen.truth import distance_field
from scenegen.truth.difficulty import search
from scenegen.worlds.place import Place
from scenegen.worlds.world import World

SPARES_M = (0.3, 0.2, 0.15, 0.1, 0.0)
"""How much farther than its radius the vehicle's path keeps from occupied voxels' centres, metres:
the first with which there is a path."""
PASSED_M = 1.0
"""A point of the way that is so near and no longer ahead is not flown back to, metres."""
RIM = 5
"""Voxels of the window's rim, a metre, in which nothing is believed yet."""
PLAN = PlanConfig(step_voxels=2, iterations=20)


def within(bounds: ArrayLike, grid: GridSpec) -> tuple[GridSpec, Ints]:
    """Find the voxels that lie wholly within bounds, at least one along each axis.

    Voxels are counted from the world's origin.

    Args:
        bounds: Least and greatest corner (2, 3), world, metres.
        grid: Its voxels have the size to use.

    Returns:
        A grid of so many voxels, and the first voxel (3,).
    """
    low, high = np.floor(np.asarray(bounds) / grid.voxel_m).astype(np.int64)
    x, y, z = np.maximum(high - low - 1, 1).tolist()
    return replace(grid, shape=(x, y, z)), low + 1


class MappingRobot:
    """Fuses scans by visibility, completes the map, plans, and flies.

    A voxel is occupied if it holds a return, or if no ray crossed it and the `completer` predicts
    it to be occupied, in a grid around the vehicle. Predictions stay where the grid has moved on,
    so dead ends are remembered. A* searches a path to the goal within the bounds; the path is
    refined as in the bench, and followed.

    Args:
        completer: A `MapCompleter`.
        memory: Whether scans are fused. If not, the map is of the last scan, and free beyond it.
        frontier: Whether to fly to the reachable point nearest to the goal if no path leads there.
        doubts: Whether observations outweigh predictions: a path stands until observed voxels make
            it narrower, and may lead through predicted voxels if there is no other. Predictions
            change as the vehicle moves.
        brakes: If given, it is never faster than it can stop before the first voxel of its path
            that no ray has crossed or returned from, and that is occupied with at least this
            probability. 0 for all of them.
        every: With memory, it completes at one of so many decisions. Sooner if its path does not
            hold any more, or if the window has moved by more than `RIM`. Between, observations are
            added to the last prediction.
    """

    def __init__(
        self,
        completer: Any,  # a MapCompleter, which may name more arguments
        *,
        memory: bool = True,
        frontier: bool = False,
        doubts: bool = False,
        brakes: float | None = None,
        every: int = 1,
    ):
        # without memory, the prediction is of one scan, too
        self._every = every if memory else 1
        self._completer, self._memory, self._frontier = completer, memory, frontier
        self._doubts, self._brakes = doubts, brakes
        self.grid: GridSpec = getattr(completer, "grid", GridSpec())

    def reset(self, about: Observation) -> None:
        """See `Robot.reset`."""
        forget(self._completer)
        # a flight is the same however many were flown before
        self._rng = np.random.default_rng(0)
        self._about = about
        self.path: Floats | None = None
        """The way that it follows, (n, 3) world metres, the goal last."""
        self._least_m = 0.0
        """Its clearance from observed voxels when it was planned, at most the wanted one, m."""
        self._fence, self._low = within(about["bounds"], self.grid)
        """The voxels in which ways are planned, and the first of them."""
        self._forget()
        self._age = self._every
        """Decisions since it completed."""
        window = np.array(self.grid.shape)
        self._least = self._low - window // 2 - 2
        self._known = np.zeros((2, *(window + self._fence.shape + 4)), bool)
        """Observed and free voxels, wherever the window may come; `_least` is the first voxel."""

    def rehearse(self) -> None:
        """Decide once for nothing, then `reset`: in a process of its own, the first decision would
        take too long, for kernels are compiled or loaded."""
        about = self._about
        self.act(
            {
                "ranges": np.full(about["times_s"].shape, np.inf, np.float32),
                "position": about["bounds"].mean(axis=0),
                "quaternion": np.array([1.0, 0.0, 0.0, 0.0]),
                "velocity": np.zeros(3),
                "goal": about["goal"],
                "time_s": np.zeros(1),
            }
        )
        MappingRobot.reset(self, about)

    def _forget(self) -> None:
        """Make all voxels free and without risk, until the window covers them."""
        shape, far = self._fence.shape, self.grid.truncation_m
        self._distance, self._risk = np.full(shape, far, np.float32), np.zeros(shape, np.float32)
        self._clear = np.zeros(shape, bool)
        """Voxels that are likely enough to be free that it does not brake for them."""
        self._seen = self._distance.copy() if self._doubts else self._distance
        """Distances from occupied voxels, and from those among them that were observed."""

    def act(self, observation: Observation) -> Floats:
        """See `Robot.act`."""
        position = observation["position"]
        self._corner = np.floor(position / self.grid.voxel_m).astype(np.int64)
        self._corner -= np.array(self.grid.shape) // 2
        # a position that drifts may be far outside the bounds, where nothing is remembered
        shape = np.array(self._known.shape[1:])
        self._corner = np.clip(self._corner, self._least, self._least + shape - self.grid.shape)
        self._see(observation)
        self._believe()
        # a path that still holds is flown on: a new one at every decision could swing to and fro
        path = self._remaining(observation)
        if path is None:
            # a robot that had no path stands still, and sees little that is new
            if self.path is not None and self._age:
                self._age = self._every
                self._believe()
            path = self._plan(observation, self._distance)
            # a prediction that closes every way may be wrong; observations are not
            if path is None and self._doubts:
                path = self._plan(observation, self._seen)
            if path is not None:
                clearance_m = float(self._about["radius_m"]) + SPARES_M[0]
                self._least_m = min(self._narrowest_m(path), clearance_m)
        self.path = path
        if path is None:
            return no_way(self._about)
        seen = None if self._brakes is None else self._known_at
        return follow(path, observation, self._about, self._room, seen)

    def taken(self) -> Mask:
        """Return the voxels `within` the bounds that the robot takes for occupied."""
        return self._distance == 0

    def _room(self, points: Floats) -> Floats:
        """Distances (n,), metres, of points (n, 3), world metres, from occupied voxels."""
        field, voxel_m = self._distance, self.grid.voxel_m
        return np.array([field_at(field, x, y, z, voxel_m)[0] for x, y, z in points - self._start])

    def _known_at(self, points: Floats) -> Mask:
        """Whether rays crossed the voxels of points (n, 3), world metres, or returned from them, or
        they are clear by the prediction."""
        voxels = np.floor(points / self.grid.voxel_m).astype(np.int64) - self._least
        voxels = np.clip(voxels, 0, np.array(self._known.shape[1:]) - 1)
        return np.asarray(self._known[:, *voxels.T].any(axis=0) | self._clear[self._voxels(points)])

    @property
    def origin(self) -> Floats:
        """The window's least corner (3,), world metres."""
        return self._corner * np.float64(self.grid.voxel_m)

    @property
    def _start(self) -> Floats:
        """The fence's least corner (3,), world metres."""
        return self._low * np.float64(self.grid.voxel_m)

    def _see(self, observation: Observation) -> None:
        quaternion = observation["quaternion"]
        arm = rotate(quaternion, self._about["lever_arm_m"][None])[0]
        pose, ranges = Pose(observation["position"] + arm, quaternion), observation["ranges"]
        # a range of 0 or NaN says nothing, infinity that the way is free
        known = is_return(ranges, min_range_m=0.0) | np.isposinf(ranges)
        rays = self._rays(known)
        seen = voxelize(Scan(ranges[known], pose, rays), self.grid, self.origin)
        self.observed, self.free, self._pose = seen.observed, seen.free, pose
        window = _box(self._corner - self._least, self.grid.shape)
        if self._memory:
            self._remember(window, observation)
        else:
            self._known[:] = False
        self._known[:, *window] = self.observed, self.free

    def _remember(self, window: tuple[slice, ...], observation: Observation) -> None:
        """Add what is known of the window from earlier scans to `observed` and `free`."""
        observed, free = self._known[:, *window]
        self.observed |= observed
        # a return outweighs rays that crossed its voxel, in this scan or an earlier one
        self.free = (self.free | free) & ~self.observed

    def _rays(self, chosen: Any) -> Any:
        """The sensor, as `lidarsim.Sensor` has it, with the `chosen` rays."""
        directions = self._about["directions_body"][chosen]
        return SimpleNamespace(
            shape=directions.shape[:-1],
            directions_body=directions,
            times_s=self._about["times_s"][chosen],
            max_range_m=float(self._about["max_range_m"]),
        )

    def _complete(self) -> None:
        """Predict the window."""
        seen = SeenMap(
            observed=self.observed,
            free=self.free,
            origin=self.origin,
            position=self._pose.position,
            quaternion=self._pose.quaternion,
            lidar=self._rays(...),
        )
        prediction = complete_seen(self._completer, seen, grid=self.grid, rng=self._rng)
        occupied = prediction.occupied(Thresholds(probability=PLAN.careful_probability))
        chance = prediction.occupancy_probability
        chance = np.zeros(occupied.shape, np.float32) if chance is None else chance
        # wide enough for the window until it has moved too far
        self._occupied, self._chance = np.pad(occupied, RIM), np.pad(chance, RIM)
        self._completed, self._age = self._corner, 0

    def believed(self) -> tuple[Mask, Field]:
        """Return the occupied voxels and the risk of all voxels of the window, (*grid.shape)."""
        self._age += 1
        if self._age >= self._every or abs(self._corner - self._completed).max() > RIM:
            self._complete()
        window = _box(self._corner - self._completed + RIM, self.grid.shape)
        # what a ray crossed is free, whatever is predicted
        occupied = self.observed | (self._occupied[window] & ~self.free)
        prediction = Prediction(occupancy_probability=self._chance[window])
        return occupied, risk_of(prediction, occupied, self.observed | self.free, PLAN)

    def _believe(self) -> None:
        """Copy occupancy and risk of the window to the fence, without the window's rim, whose
        distances lack the obstacles beyond."""
        occupied, risk = self.believed()
        if not self._memory:
            self._forget()
        corner, shape = self._corner, np.array(self.grid.shape)
        low = np.maximum(corner + RIM, self._low)
        count = np.maximum(np.minimum(corner + shape - RIM, self._low + self._fence.shape) - low, 0)
        in_fence, in_window = _box(low - self._low, count), _box(low - corner, count)
        self._distance[in_fence] = distance_field(occupied, self.grid)[in_window]
        if self._doubts:
            self._seen[in_fence] = distance_field(self.observed, self.grid)[in_window]
        self._risk[in_fence] = risk[in_window]
        if self._brakes:
            self._clear[in_fence] = risk[in_window] < self._brakes

    def _remaining(self, observation: Observation) -> Floats | None:
        """Return the rest of the last path, (n, 3) world metres; None if its end is reached, or if
        observations since have made it narrower. Without it, two ways out could take turns."""
        position = observation["position"]
        if self.path is None or math.dist(position, self.path[-1]) < self._about["reach_m"]:
            return None
        legs, way = np.diff(self.path, axis=0), position - self.path[:-1]
        lengths = np.maximum((legs * legs).sum(axis=1), 1e-12)
        along = np.clip((way * legs).sum(axis=1) / lengths, 0, 1)
        away = ((way - along[:, None] * legs) ** 2).sum(axis=1)
        # from the nearest leg on; points beside the vehicle that it has passed are skipped
        leg, far = int(np.argmin(away)), len(legs) - 1
        while leg < far and way[leg + 1] @ legs[leg + 1] > 0 and abs(way[leg + 1]).max() < PASSED_M:
            leg += 1
        path = np.concatenate([position[None], self.path[leg + 1 :]])
        return path if self._narrowest_m(path) >= self._least_m else None

    def _narrowest_m(self, path: Floats) -> float:
        """Least distance of a path (n, 3) from observed voxels, metres; its start is left out."""
        return float(self._seen[self._voxels(_halved(path)[1:])].min())

    def _voxels(self, points: Floats) -> tuple[Ints, ...]:
        """The fence's voxels that hold `points` (n, 3), world metres, or are next to them."""
        voxels = np.floor((points - self._start) / self.grid.voxel_m).astype(np.int64)
        return tuple(np.clip(voxels, 0, np.array(self._fence.shape) - 1).T)

    def _plan(self, observation: Observation, distance: Field) -> Floats | None:
        """A path (n, 3) from the vehicle to the goal, world metres, that keeps its `distance`."""
        step, voxel_m, goal = PLAN.step_voxels, self.grid.voxel_m, observation["goal"]
        radius, position = float(self._about["radius_m"]), observation["position"]
        start = position + lag_s(self._about) * observation["velocity"]  # no sooner can it turn
        # the search needs a free start, and the point ahead may lie too near an obstacle
        if distance[self._voxels(start[None])] < radius:
            start = position
        ends = np.transpose(self._voxels(np.stack([start, goal])))
        first = ends[0] % step
        shape = (np.array(self._fence.shape) - 1 - first) // step + 1
        node = np.minimum(np.rint((ends[1] - first) / step).astype(np.int64), shape - 1)
        # the widest berth first: narrow doors have a path only with less
        for spare in SPARES_M:
            blocked = distance < radius + spare
            # the search needs a free goal, and to be within `reach_m` of it is enough
            blocked[tuple(first + step * node)] = False
            begin = ends[0] // step
            if self._frontier:
                node = _nearest(blocked[tuple(slice(at, None, step) for at in first)], begin, node)
                goal = self._start + (first + step * node + 0.5) * voxel_m
                if (node == begin).all():
                    continue
            rough = self._searched(blocked, first, shape, begin, node)
            if len(rough):
                break
        else:
            return None
        path = refine(rough, distance, self._fence, PLAN) if len(rough) > 2 else rough
        # refining must not lead into voxels that the search avoided
        met = self._voxels(_halved(path)[1:] + self._start)
        path = (rough if (blocked | (self._risk > RATHER))[met].any() else path) + self._start
        return np.concatenate([[position, start], path[1:], goal[None]])

    def _searched(self, blocked: Mask, first: Ints, shape: Ints, begin: Ints, node: Ints) -> Floats:
        """Search a path on a lattice of every `PLAN.step_voxels`-th voxel of the fence.

        Args:
            blocked: Voxels to avoid (*fence).
            first: Voxel (3,) of the first node.
            shape: Nodes (3,) along each axis.
            begin: The path's first node (3,).
            node: Its last one (3,).

        Returns:
            Points (n, 3), metres from the fence's least corner; (0, 3) without a path.
        """
        step, weight = PLAN.step_voxels, PLAN.risk_weight
        nodes = search(blocked, first, shape, step, begin, node, True, self._risk, weight)
        return np.asarray((first + step * nodes + 0.5) * self.grid.voxel_m)


def _nearest(blocked: Mask, begin: Ints, goal: Ints) -> Ints:
    """The node (3,) nearest to the `goal` of those that can be reached from `begin` by steps along
    the axes, by which nodes are `blocked`."""
    free = ~blocked
    free[tuple(begin)] = True
    # by faces only: between diagonal neighbours, the search may find the edge blocked
    parts, _ = ndimage.label(free)
    nodes: Ints = np.argwhere(parts == parts[tuple(begin)])
    return nodes[np.argmin(((nodes - goal) ** 2).sum(axis=1))]


def _halved(path: Floats) -> Floats:
    """The points of a path (n, 3), and those halfway between them, (2 n - 1, 3)."""
    doubled = np.repeat(path, 2, axis=0)
    return 0.5 * (doubled[:-1] + doubled[1:])


def _box(low: Ints, count: ArrayLike) -> tuple[slice, ...]:
    """The voxels from `low` (3,) on, so many along each axis."""
    return tuple(map(slice, low, low + np.asarray(count)))


class TruthRobot(MappingRobot):
    """Robot that knows the world. It is a reference, not an upper bound: it takes the shortest path
    that its voxels allow, which may pass close to solids."""

    def __init__(self, world: World | Place):
        super().__init__(ReturnsCompleter())  # which it does not ask
        self._world = world

    def believed(self) -> tuple[Mask, Field]:
        """See `MappingRobot.believed`."""
        truth = self._world.truth(self.grid, self.origin)
        occupied = truth["occupancy"] | ~truth.get("known", np.bool_(True))
        return occupied, occupied.astype(np.float32)

    def _see(self, observation: Observation) -> None:
        """Ignore scans: the truth is known."""
