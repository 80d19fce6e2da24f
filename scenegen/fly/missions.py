"""Draws missions: a start and a goal that are free, far apart and connected by a path."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarsim import GridSpec
from lidarsim.grid import Field, Floats, Ints, Mask
from scenegen.base.errors import GenerationError
from scenegen.fly import Rules, Vehicle
from scenegen.truth import distance_field
from scenegen.truth.difficulty import NO_RISK, Difficulty, search, way_difficulty
from scenegen.worlds.place import Place
from scenegen.worlds.world import AnyWorld, World

VOXEL_M = 0.1
"""Edge of the voxels of the search for the shortest way, metres."""
MARGIN = 10
"""Voxels around the flight bounds whose solids count."""
TRIES = {World: 200, Place: 10_000}
"""Pairs drawn for a mission before a world counts as too narrow; more for a map, which is mostly
unknown."""
DETOUR_TRIES = 5
"""So many times as many where the rules ask for a detour."""
CALM_S = 1.0
"""For so long no mover comes near the start, seconds."""
ROOMS = 20
"""Parts of a map that are tried for a mission before the map counts as too narrow."""
BESIDE = 4
"""Voxels: so near is the place from which a vehicle goes on that ended where it does not fit."""
Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Mission:
    """A start and a goal, in the world."""

    start: Point
    """Where the robot starts, metres."""
    goal: Point
    """Where it has to fly, metres."""
    shortest_m: float
    """Length of the path by A* through the truth, straightened, metres."""
    bounds: tuple[Point, Point]
    """Lower and upper corner of the box that the vehicle's centre must not leave, metres."""

    @property
    def straight_m(self) -> float:
        """Distance from start to goal, metres."""
        return math.dist(self.start, self.goal)


def draw_missions(
    world: AnyWorld, vehicle: Vehicle, rules: Rules, count: int, *, seed: int
) -> list[Mission]:
    """Draw missions through a world. A mission does not depend on how many are drawn.

    Args:
        world: The world.
        vehicle: The vehicle, which must fit.
        rules: Distance and clearance of start and goal.
        count: Number of missions.
        seed: Seed of the missions.

    Raises:
        GenerationError: The world is too narrow.
    """
    missions: list[Mission] = []
    room = None
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        for n in range(ROOMS):
            bounds = world.room(vehicle.radius_m, rules.apart_m, rng=rng)
            if room is None or not np.array_equal(bounds, room.bounds):
                room = _room(world, bounds, vehicle.radius_m + rules.berth_m)
            elif n:  # a world has one room: trying it again would fail again
                continue
            apart = min(rules.apart_m, math.dist(*bounds) / 2)
            # as far apart as the rules say, else half, else a quarter as far; not for detours, of
            # which it takes long to find that there are none
            parts = (1,) if rules.detour > 1 else (1, 2, 4)
            tries = (_draw(world, vehicle, rules, apart / part, room, rng=rng) for part in parts)
            if drawn := next(filter(None, tries), None):
                missions.append(drawn)
                break
        else:
            raise GenerationError(
                f"no start and goal {apart / parts[-1]:g} m apart with a way between; give a "
                "smaller --apart or --radius, or another world"
            )
    return missions


class _Room(NamedTuple):
    """Voxels of a part of a world in which missions are drawn."""

    bounds: Floats
    """See `Mission.bounds`, (2, 3)."""
    grid: GridSpec
    """The grid, over the bounds and `MARGIN` voxels around them."""
    origin: Floats
    """The grid's lower corner in the world (3,), metres."""
    blocked: Mask
    """(*grid.shape): voxels in which the vehicle's centre would collide."""
    solid: Mask
    """(*grid.shape): voxels that are occupied or unknown."""
    tudf: Field
    """(*grid.shape): distance from the nearest solid voxel, metres."""


def _room(world: AnyWorld, bounds: Floats, radius_m: float) -> _Room:
    """Return the voxels within `bounds` (2, 3) for a vehicle of this radius."""
    shape = np.ceil((bounds[1] - bounds[0]) / VOXEL_M).astype(int) + 2 * MARGIN
    x, y, z = shape.tolist()
    grid = GridSpec(shape=(x, y, z), voxel_m=VOXEL_M)
    origin = bounds[0] - MARGIN * VOXEL_M
    truth = world.truth(grid, origin)
    solid = truth["occupancy"] | ~truth.get("known", np.bool_(True))
    # a solid is at most half a voxel's diagonal nearer than its voxel's centre
    tudf = distance_field(solid, grid)
    near = tudf < radius_m + VOXEL_M * math.sqrt(3) / 2
    inner = (slice(MARGIN, -MARGIN),) * 3
    # beyond the flight bounds nothing may fly, though solids there count
    blocked = np.ones_like(near)
    blocked[inner] = near[inner]
    return _Room(bounds, grid, origin, blocked, solid, tudf)


def _way(blocked: Mask, ends: Ints) -> Ints:
    """Return the voxels (n, 3) of the shortest way between two (2, 3); (0, 3) if there is none."""
    first, shape = np.zeros(3, int), np.array(blocked.shape)
    nodes: Ints = search(blocked, first, shape, 1, ends[0], ends[1], False, NO_RISK, 0.0)
    return nodes


def progress(world: AnyWorld, mission: Mission, radius_m: float, end: Point) -> float:
    """Measure the share of the shortest way to the goal that is gained at a position.

    Args:
        world: The world.
        mission: The mission.
        radius_m: Radius of the vehicle, metres.
        end: The position, metres in the world. If the vehicle does not fit there, the nearest
            voxel within `BESIDE` voxels in which it fits counts.

    Returns:
        From 0 to 1; 0 if no way leads on to the goal.
    """
    room = _room(world, np.array(mission.bounds), radius_m)
    # a flight may have ended beyond the bounds
    inside = np.clip(end, *room.bounds)
    start, goal, last = room.grid.index(
        np.array([mission.start, mission.goal, inside]), room.origin
    )
    low = np.maximum(last - BESIDE, 0)
    near = np.argwhere(~room.blocked[tuple(map(slice, low, last + BESIDE + 1))]) + low
    if not len(near):
        return 0.0
    last = near[((near - last) ** 2).sum(axis=1).argmin()]
    whole, left = (_way(room.blocked, np.stack([begin, goal])) for begin in (start, last))
    if not len(left):
        return 0.0
    lengths = [
        float(np.sqrt((np.diff(way, axis=0) ** 2).sum(axis=1)).sum()) for way in (whole, left)
    ]
    # at least a voxel, since start and goal may lie in the same one
    return min(max(1 - lengths[1] / max(lengths[0], 1.0), 0.0), 1.0)


def graded(world: AnyWorld, radius_m: float, missions: Sequence[Mission]) -> list[Difficulty]:
    """Measure how difficult missions are, by the shortest way through voxels of `VOXEL_M`.

    Args:
        world: The world.
        radius_m: Radius of the vehicle and its berth, metres.
        missions: Missions through this world.

    Returns:
        The difficulty of each mission; its tortuosity is that of the straightened way.
    """
    difficulties: list[Difficulty] = []
    for number, mission in enumerate(missions):
        # missions of one world share their room, which is slow to make
        if not number or mission.bounds != missions[number - 1].bounds:
            room = _room(world, np.array(mission.bounds), radius_m)
        ends = room.grid.index(np.array([mission.start, mission.goal]), room.origin)
        way = _way(room.blocked, ends)
        tortuosity = mission.shortest_m / mission.straight_m
        difficulties.append(way_difficulty(way, tortuosity, room.solid, room.tudf, VOXEL_M))
    return difficulties


def _draw(
    world: AnyWorld,
    vehicle: Vehicle,
    rules: Rules,
    apart: float,
    room: _Room,
    *,
    rng: np.random.Generator,
) -> Mission | None:
    """Draw a start and a goal at least `apart` metres from one another, both clear of obstacles and
    connected by a way that the vehicle fits through, as long as the rules ask; None if no pair is
    found."""
    bounds, clearance, spare = room.bounds, world.clearance, vehicle.radius_m + rules.spare_m
    radius = vehicle.radius_m + rules.berth_m
    movers = world.movers if isinstance(world, World) else None
    inset = np.minimum(spare, (bounds[1] - bounds[0]) / 4)
    tries = TRIES[type(world)] * (DETOUR_TRIES if rules.detour > 1 else 1)
    for pair in rng.uniform(bounds[0] + inset, bounds[1] - inset, (tries, 2, 3)):
        voxels = room.grid.index(pair, room.origin)
        # centres of voxels, where the way found by A* begins and ends
        start, goal = room.origin + (voxels + 0.5) * VOXEL_M
        if (
            # cheap tests come first: most pairs fail, and the search for a way is slow
            math.dist(start, goal) < apart
            or room.blocked[tuple(voxels.T)].any()
            or min(clearance.at(*start), clearance.at(*goal)) < spare
            # a straight way is no detour: the search, which is slow, would find it
            or (rules.detour > 1 and clearance.motion_is_free(tuple(start), tuple(goal), radius))
            or (movers is not None and movers.distances_m(start[None], 0.0, CALM_S)[0] < spare)
        ):
            continue
        nodes = _way(room.blocked, voxels)
        if not len(nodes):
            continue
        path = room.origin + (nodes + 0.5) * VOXEL_M  # centres of voxels
        # straighten: from each point go to the farthest that can be reached in a line
        begin, shortest = 0, 0.0
        while begin < len(path) - 1:
            end = len(path) - 1
            while end > begin + 1 and not clearance.motion_is_free(
                tuple(path[begin]), tuple(path[end]), radius
            ):
                end -= 1
            shortest += math.dist(path[begin], path[end])
            begin = end
        if shortest < rules.detour * math.dist(start, goal):
            continue
        ends = [tuple(point.tolist()) for point in (start, goal, *bounds)]
        return Mission(start=ends[0], goal=ends[1], shortest_m=shortest, bounds=(ends[2], ends[3]))
    return None
