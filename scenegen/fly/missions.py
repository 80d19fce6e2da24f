"""Starts and goals by rule: free, far apart, and connected; and how long the shortest way is."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec
from scenegen.errors import GenerationError
from scenegen.fly import Rules, Vehicle
from scenegen.truth import distance_field
from scenegen.worlds.place import Place
from scenegen.worlds.search import NO_RISK, search
from scenegen.worlds.world import World

VOXEL_M = 0.1
"""Edge of the voxels through which the shortest way is searched, metres."""
MARGIN = 10
"""Voxels around the flight bounds whose solids count, too."""
TRIES = 200
"""Pairs drawn for each mission before a world counts as too narrow."""

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Mission:
    """From where to where a robot flies."""

    start: Point
    """World metres."""
    goal: Point
    """World metres."""
    shortest_m: float
    """Length of the shortest way that is known, metres: A*'s through the truth, straightened."""
    bounds: tuple[Point, Point]
    """Least and greatest corner of the box that the vehicle's centre may not leave, metres."""


def draw_missions(
    world: World | Place, vehicle: Vehicle, rules: Rules, count: int, *, seed: int
) -> list[Mission]:
    """`count` missions through a world, by `seed`. A mission does not depend on how many are drawn.

    Raises:
        GenerationError: The world is too narrow.
    """
    found: list[Mission] = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        bounds = world.room(vehicle.radius_m, rules.apart_m, rng=rng)
        if not found or not np.array_equal(bounds, found[-1].bounds):
            grid, origin, blocked = _blocked(world, bounds, vehicle.radius_m)
        apart = min(rules.apart_m, math.dist(*bounds) / 2)
        tries = (
            _draw(world, vehicle, rules, apart / part, bounds, grid, origin, blocked, rng=rng)
            for part in (1, 2, 4)
        )
        made = next(filter(None, tries), None)
        if made is None:
            raise GenerationError(
                f"no start and goal {apart / 4:g} m apart with a way between; give a smaller "
                "--apart or --radius, or another world"
            )
        found.append(made)
    return found


def _blocked(
    world: World | Place, bounds: NDArray[np.float64], radius_m: float
) -> tuple[GridSpec, NDArray[np.float64], NDArray[np.bool_]]:
    """A grid over the bounds, its least corner (3,), and where in it a ball's centre may not be."""
    shape = np.ceil((bounds[1] - bounds[0]) / VOXEL_M).astype(int) + 2 * MARGIN
    x, y, z = shape.tolist()
    grid = GridSpec(shape=(x, y, z), voxel_m=VOXEL_M)
    origin = bounds[0] - MARGIN * VOXEL_M
    truth = world.truth(grid, origin)
    solid = truth["occupancy"] | ~truth.get("known", np.bool_(True))
    # a solid is at most half a voxel's diagonal nearer than its voxel's centre
    near = distance_field(solid, grid) < radius_m + VOXEL_M * math.sqrt(3) / 2
    inner = (slice(MARGIN, -MARGIN),) * 3
    blocked = np.ones_like(near)
    blocked[inner] = near[inner]
    return grid, origin, blocked


def _draw(
    world: World | Place,
    vehicle: Vehicle,
    rules: Rules,
    apart: float,
    bounds: NDArray[np.float64],
    grid: GridSpec,
    origin: NDArray[np.float64],
    blocked: NDArray[np.bool_],
    *,
    rng: np.random.Generator,
) -> Mission | None:
    clearance, spare = world.clearance, vehicle.radius_m + rules.spare_m
    inset = np.minimum(spare, (bounds[1] - bounds[0]) / 4)
    for pair in rng.uniform(bounds[0] + inset, bounds[1] - inset, (TRIES, 2, 3)):
        voxels = grid.index(pair, origin)
        start, goal = origin + (voxels + 0.5) * VOXEL_M
        if (
            math.dist(start, goal) < apart
            or blocked[tuple(voxels.T)].any()
            or min(clearance.at(*start), clearance.at(*goal)) < spare
        ):
            continue
        first, shape = np.zeros(3, int), np.array(grid.shape)
        nodes = search(blocked, first, shape, 1, voxels[0], voxels[1], False, NO_RISK, 0.0)
        if not len(nodes):
            continue
        path = origin + (nodes + 0.5) * VOXEL_M
        here, shortest = 0, 0.0
        while here < len(path) - 1:
            there = len(path) - 1
            while there > here + 1 and not clearance.motion_is_free(
                tuple(path[here]), tuple(path[there]), vehicle.radius_m
            ):
                there -= 1
            shortest += math.dist(path[here], path[there])
            here = there
        ends = [tuple(point.tolist()) for point in (start, goal, *bounds)]
        return Mission(start=ends[0], goal=ends[1], shortest_m=shortest, bounds=(ends[2], ends[3]))
    return None
