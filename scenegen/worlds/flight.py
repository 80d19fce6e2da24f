"""Flights: OMPL's RRT between a random start and goal, viewpoints along the path, and a quadrotor's
tilt there."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.random import Generator
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from lidarsim import Pose
from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats, Vector
from lidarsim.parameters import MAX_LENGTH_M, check, number
from scenegen.base.errors import GenerationError, check_int
from scenegen.base.limits import (
    MAX_CANDIDATES,
    MAX_DRAWN_M,
    MAX_FLIGHTS,
    MAX_ITERATIONS,
    MAX_SEED,
    MAX_VIEWPOINTS,
    MIN_DRAWN_M,
)
from scenegen.worlds.clearance import CAP_M, Clearance
from scenegen.worlds.mapping import Mapper
from scenegen.worlds.place import LOCAL, Place
from scenegen.worlds.world import AnyWorld

GRAVITY = 9.81
"""Metres a second squared."""
MIN_THRUST = 0.5
"""Lower bound of the thrust's vertical part, as a share of the thrust in hover."""

# OMPL would print lines on every search
ou.noOutputHandler()


@dataclass(frozen=True, kw_only=True)
class FlightConfig:
    """How a sensor flies through a world, and where along the way it scans."""

    robot_radius_m: float = number(0.3, above=0, below=CAP_M)
    """Clearance that every point of a flight keeps, metres."""
    altitude_m: tuple[float, float] = number(
        (1.5, 5.0), minimum=-MAX_DRAWN_M, maximum=MAX_DRAWN_M, rising=True
    )
    """Heights between which flights keep, metres; a world from an MJCF file brings its own
    bounds."""
    margin_m: float = number(8.0, minimum=0, maximum=MAX_DRAWN_M)
    """Distance of flights from a drawn world's lateral edges, metres: by default half a map."""
    min_distance_m: float = number(10.0, minimum=0, maximum=MAX_LENGTH_M)
    """Minimum distance between start and goal, metres; at most a third of the flight bounds'
    diagonal."""
    viewpoints: int = number(5, minimum=1, maximum=MAX_VIEWPOINTS)
    """Samples a flight gives."""
    spacing_m: float = number(1.0, minimum=MIN_DRAWN_M, maximum=MAX_LENGTH_M)
    """Least distance between two viewpoints of a flight, metres."""
    iterations: int = number(2000, minimum=1, maximum=MAX_ITERATIONS)
    """Iterations after which RRT gives up."""
    step_m: float = number(3.0, minimum=MIN_DRAWN_M, maximum=MAX_LENGTH_M)
    """Longest edge of the RRT, metres."""
    goal_tolerance_m: float = number(0.5, minimum=MIN_DRAWN_M, maximum=MAX_LENGTH_M)
    """How near to its goal a flight must end, metres."""
    flights_per_world: int = number(3, minimum=1, maximum=MAX_FLIGHTS)
    """Flights tried in one drawn world before it is rejected."""

    def __post_init__(self) -> None:
        check(self)
        if self.altitude_m[0] == self.altitude_m[1]:
            raise ValueError(
                f"altitude_m = {list(self.altitude_m)}: expected [low, high] in metres, low < high"
            )

    def bounds(self, size_m: Vector) -> Floats:
        """Compute the box of flights through a drawn world.

        Args:
            size_m: The world's extent, metres.

        Returns:
            Least and greatest corner, (2, 3), metres.

        Raises:
            ValueError: If the margin leaves no box.
        """
        (low, high), margin = self.altitude_m, self.margin_m
        box = np.array([[margin, margin, low], [size_m[0] - margin, size_m[1] - margin, high]])
        if not (box[0] < box[1]).all():
            raise ValueError(
                f"[flight] margin_m = {self.margin_m}: leaves no room to fly in a world of "
                f"{list(size_m)} metres"
            )
        return box


Sees = Callable[[Floats], bool]
"""Tells whether enough of a map is known around a point (3,), world metres, to scan there."""


def plan_flight(
    world: AnyWorld, flight: FlightConfig, *, rng: Generator, sees: Sees | None = None
) -> Floats | None:
    """Draw a collision-free path between a random start and goal by RRT (LaValle 1998) as OMPL has
    it.

    The same `rng` state gives the same path: OMPL's own generator is seeded from it before a fresh
    planner is made, and the search ends on a count of iterations, never on time.

    Args:
        world: The world.
        flight: Parameters of the flight.
        rng: Draws start, goal and seed.
        sees: In a map of a real place, both ends of the path must pass it, and heights are those of
            `flight`.

    Returns:
        The path (n, 3), metres; None if none was found.
    """
    clearance = world.clearance
    planner_type = og.RRT
    if sees is None or not isinstance(world, Place):
        bounds = world.room(flight.robot_radius_m, flight.min_distance_m, rng=rng)
        ends = _start_and_goal(clearance, bounds, flight, rng=rng)
    else:
        bounds, ends = _ends_in_map(world, flight, sees, rng=rng)
        # in dense maps, RRT finds almost no way, even between ends that free space joins
        planner_type = og.RRTConnect
    # drawn even without ends, so that later draws do not depend on them
    seed = int(rng.integers(1, 2**31))
    solution = (
        None if ends is None else connect(clearance, bounds, flight, ends, seed, planner_type)
    )
    return None if solution is None else points_of(solution[1])


def connect(
    clearance: Clearance,
    bounds: Floats,
    flight: FlightConfig,
    ends: tuple[Floats, Floats],
    seed: int,
    planner_type: Any = og.RRT,
) -> tuple[ob.SpaceInformation, og.PathGeometric] | None:
    """Search a path between two points by RRT.

    Args:
        clearance: The collision check.
        bounds: (2, 3): the box of the search, world metres.
        flight: Radius of the robot, and the planner's parameters.
        ends: Start and goal, (3,) each.
        seed: Seed of OMPL's generator.
        planner_type: OMPL's class of the planner: RRT, or RRTConnect (Kuffner and LaValle 2000),
            which finds more of the ways through dense maps.

    Returns:
        OMPL's path, with the space that checks its motions; None if RRT finds none.
    """
    ou.RNG.setSeed(seed)
    space, box = ob.RealVectorStateSpace(3), ob.RealVectorBounds(3)
    for axis, (low, high) in enumerate(bounds.T.tolist()):
        box.setLow(axis, low)
        box.setHigh(axis, high)
    space.setBounds(box)
    information = ob.SpaceInformation(space)
    # states need no check: that of motions covers their ends
    information.setStateValidityChecker(lambda state: True)
    information.setMotionValidator(_Motions(information, clearance, flight.robot_radius_m))
    information.setup()
    problem = ob.ProblemDefinition(information)
    states = space.allocState(), space.allocState()
    for state, point in zip(states, ends, strict=True):
        state[0], state[1], state[2] = point.tolist()
    problem.setStartAndGoalStates(*states, flight.goal_tolerance_m)
    planner = planner_type(information)
    planner.setRange(flight.step_m)
    planner.setProblemDefinition(problem)
    planner.setup()
    # OMPL evaluates the condition once an iteration
    rounds = iter(range(flight.iterations))
    status = planner.solve(ob.PlannerTerminationCondition(lambda: next(rounds, None) is None))
    # an approximate path ends elsewhere than at the goal
    if status.getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    return information, problem.getSolutionPath()


def points_of(path: og.PathGeometric) -> Floats:
    """Convert a path of OMPL's to points (n, 3)."""
    return np.array([_place(state) for state in path.getStates()])


def _place(state: ob.State) -> Vector:
    return state[0], state[1], state[2]


class _Motions(ob.MotionValidator):
    """OMPL's edge check by `Clearance.motion_is_free`: one call an edge, exact to a millimetre."""

    def __init__(self, information: ob.SpaceInformation, clearance: Clearance, radius_m: float):
        super().__init__(information)
        self._clearance, self._radius_m = clearance, radius_m

    def checkMotion(  # noqa: N802 (OMPL's name)
        self, a: ob.State, b: ob.State, last_valid: object = None
    ) -> bool:
        """Test the edge from `a` to `b`.

        Returns:
            Whether it is free.
        """
        return self._clearance.motion_is_free(_place(a), _place(b), self._radius_m)


def _start_and_goal(
    clearance: Clearance, bounds: Floats, flight: FlightConfig, *, rng: Generator
) -> tuple[Floats, Floats] | None:
    """Draw two free points far enough apart; None after a hundred draws."""
    min_distance, start = apart(bounds, flight), None
    for point in rng.uniform(bounds[0], bounds[1], (100, 3)):
        if clearance.at(*point) < flight.robot_radius_m:
            continue
        if start is None:
            start = point
        elif ((point - start) ** 2).sum() >= min_distance * min_distance:
            return start, point
    return None


def heights(place: Place, flight: FlightConfig) -> Floats:
    """Compute the box of flights through a map.

    Args:
        place: The map.
        flight: Gives altitudes.

    Returns:
        (2, 3): the box around what is free between these altitudes, metres.
    """
    bounds = place.flight_bounds.copy()
    bounds[:, 2] = np.clip(bounds[:, 2], *flight.altitude_m)
    return bounds


def around(box: Floats, start: Floats, flight: FlightConfig) -> Floats:
    """Cut a box to that part of it in which a flight is planned.

    Args:
        box: (2, 3), metres.
        start: (3,): where it begins, metres.
        flight: Gives its length.

    Returns:
        (2, 3), metres.
    """
    reach = LOCAL * flight.min_distance_m
    return np.clip([start - reach, start + reach], *box)


def apart(box: Floats, flight: FlightConfig) -> float:
    """Compute the least distance from start to goal.

    Args:
        box: (2, 3): where both lie, metres.
        flight: Gives the distance in a large box.

    Returns:
        Metres.
    """
    return min(flight.min_distance_m, float(np.sqrt(((box[1] - box[0]) ** 2).sum())) / 3)


def _ends_in_map(
    place: Place, flight: FlightConfig, sees: Sees, *, rng: Generator
) -> tuple[Floats, tuple[Floats, Floats] | None]:
    """Draw start and goal where the map is free, wide and known, and the box of the search."""
    clearance, box, start = place.clearance, heights(place, flight), None

    def draw(apart_m: float) -> Floats | None:
        for point in rng.uniform(box[0], box[1], (POINTS, 3)):
            is_far = start is None or ((point - start) ** 2).sum() >= apart_m * apart_m
            # the dearest test last: `sees` casts rays through the map
            if is_far and clearance.at(*point) >= flight.robot_radius_m and sees(point):
                return point
        return None

    if (start := draw(0.0)) is None:
        return box, None
    box = around(box, start, flight)
    goal = draw(apart(box, flight))
    return box, None if goal is None else (start, goal)


class Route:
    """A path of straight legs, (n, 3) world metres, parametrized by the metres flown."""

    def __init__(self, path: Floats):
        self.path, self.legs = path, np.diff(path, axis=0)
        self.lengths = np.sqrt((self.legs**2).sum(axis=1))
        self.ends = np.concatenate([[0.0], np.cumsum(self.lengths)])
        """(n,): metres flown at each point."""
        # on a leg straight up, the body keeps its heading
        level = np.sqrt(self.legs[:, 0] * self.legs[:, 0] + self.legs[:, 1] * self.legs[:, 1])
        turned = np.where(level > 1e-6, np.arange(len(self.legs)), 0)
        headings = np.where(level[:, None] > 1e-6, self.legs[:, :2], (1.0, 0.0))
        self.headings = headings[np.maximum.accumulate(turned)]
        """(n - 1, 2): where the body looks, x and y, of any length."""

    @cached_property
    def turns(self) -> tuple[Floats, Floats]:
        """Changes of the direction of flight at each point, its begin and end included, (k, 3), and
        the metres flown there, (k,)."""
        moving = self.lengths > 0.0
        direction = self.legs[moving] / self.lengths[moving, None]
        # the flight begins and ends at rest
        still = np.zeros((1, 3))
        change = np.diff(np.concatenate([still, direction, still]), axis=0)
        return change, self.ends[np.append(moving, True)]

    def at(self, flown_m: Floats) -> tuple[Floats, Floats]:
        """Compute positions (m, 3), metres, and headings (m, 2), of any length, at `flown_m`
        (m,)."""
        # the end of the path belongs to its last leg
        leg = np.minimum(np.searchsorted(self.ends, flown_m, side="right") - 1, len(self.legs) - 1)
        along = (flown_m - self.ends[leg]) / self.lengths[leg]
        return self.path[leg] + along[:, None] * self.legs[leg], self.headings[leg]

    def pose(self, flown_m: float, mapping: Mapper | None = None) -> Pose:
        """Compute the body's pose, which looks along the path.

        Args:
            flown_m: Metres flown.
            mapping: Its speed tilts the body; None keeps it level.

        Returns:
            The pose.
        """
        (position,), (heading,) = self.at(np.array([flown_m]))
        level = Pose.facing(position, heading)
        if mapping is None or not mapping.tilt_mps:
            return level
        pull = acceleration(
            *self.turns, flown_m, speed_mps=mapping.tilt_mps, settle_s=mapping.settle_s
        )
        return leaning(level, pull, max_deg=mapping.most_tilt_deg)

    def before(self, flown_m: float, mapping: Mapper) -> list[Pose]:
        """Compute the poses of a viewpoint's earlier scans.

        Args:
            flown_m: Metres flown at the viewpoint.
            mapping: Count and distance of the scans.

        Returns:
            The poses, the last one first; scans before the start are taken at the start.
        """
        back = [mapping.scan_spacing_m * number for number in range(1, mapping.scans)]
        return [self.pose(max(flown_m - metres, 0.0), mapping) for metres in back]


def viewpoints(path: Floats, spacing_m: float, *, rng: Generator) -> tuple[Route, Floats]:
    """Choose candidate viewpoints on a path.

    Args:
        path: (n, 3), metres.
        spacing_m: Their distance along it, metres.
        rng: Draws the first, and the order.

    Returns:
        The route, and the metres flown along it to each, (m,), in random order.

    Raises:
        GenerationError: If there would be more than `MAX_CANDIDATES`.
    """
    route = Route(path)
    length = route.ends[-1]
    if length > MAX_CANDIDATES * spacing_m:
        raise GenerationError(
            f"flight.spacing_m = {spacing_m}: more than {MAX_CANDIDATES} places to scan from on a "
            f"flight of {length:.0f} m; raise it"
        )
    # a random phase: else the first viewpoint would always be the start
    flown = np.arange(rng.uniform(0.0, spacing_m), length, spacing_m)
    return route, flown[rng.permutation(len(flown))]


def poses_in_flight(world: AnyWorld, *, seed: int, every_m: float | None = None) -> list[Pose]:
    """Draw a flight through a world, and return its viewpoints in order.

    Args:
        world: The world.
        seed: Seed of the flight.
        every_m: Metres between viewpoints; those of a sample's flight by default.

    Returns:
        Level poses.

    Raises:
        GenerationError: If no flight fits.
        DatasetError: If the seed is not a whole number from 0 on.
    """
    flight = FlightConfig() if every_m is None else FlightConfig(spacing_m=every_m)
    route, flown = _flown(world, flight, seed)
    return [route.pose(metres) for metres in sorted(flown)]


def pose_in_flight(world: AnyWorld, *, seed: int) -> Pose:
    """Draw a viewpoint of a random flight.

    Args:
        world: The world.
        seed: Seed of the flight.

    Returns:
        A level pose.

    Raises:
        GenerationError: If no flight fits.
    """
    route, flown = _flown(world, FlightConfig(), seed)
    return route.pose(flown[0])


def _flown(world: AnyWorld, flight: FlightConfig, seed: int) -> tuple[Route, Floats]:
    rng = np.random.default_rng(check_int("flight: seed =", seed, 0, MAX_SEED))
    for _ in range(TRIES):
        path = plan_flight(world, flight, rng=rng)
        if path is not None and (drawn := viewpoints(path, flight.spacing_m, rng=rng))[1].size:
            return drawn
    raise GenerationError(f"no flight fits between the solids in {TRIES} tries; give --pose")


def acceleration(
    turns: Floats,
    ends_m: Floats,
    flown_m: float,
    *,
    speed_mps: float,
    settle_s: float,
) -> Vector:
    """Compute the acceleration along a path of straight legs, flown at constant speed.

    Each change of velocity is spread over `settle_s` before and after, by a triangle: this is the
    second derivative of the path smoothed by that triangle.

    Args:
        turns: (n, 3): changes of the direction, a unit vector, at the path's points.
        ends_m: (n,): metres flown at these.
        flown_m: Metres flown.
        speed_mps: Metres a second.
        settle_s: Seconds.

    Returns:
        x, y, z, metres a second squared, in the world.
    """
    shares = 1.0 - np.abs((flown_m - ends_m) / speed_mps) / settle_s
    near = shares > 0.0
    pulls = speed_mps * turns[near] * shares[near, None] / settle_s
    x, y, z = pulls.sum(axis=0, initial=0.0).tolist()  # along the first axis, sums run in order
    return x, y, z


def leaning(pose: Pose, pull: Vector, *, max_deg: float) -> Pose:
    """Tilt a body as a quadrotor's thrust demands, the shortest way, so that its heading stays.

    Args:
        pose: The level pose.
        pull: Acceleration, metres a second squared, in the world.
        max_deg: The greatest tilt, degrees.

    Returns:
        The tilted pose.
    """
    up = max(GRAVITY + pull[2], MIN_THRUST * GRAVITY)
    w, _, _, z = pose.quaternion.tolist()
    cosine, sine = w * w - z * z, 2 * w * z
    # the acceleration in the body's level frame
    forward, left = cosine * pull[0] + sine * pull[1], cosine * pull[1] - sine * pull[0]
    sideways = math.sqrt(forward * forward + left * left)
    max_sine, max_cosine = (float(value) for value in sin_cos(math.radians(max_deg)))
    # the tilt's tangent is sideways / up, here without a division
    if sideways * max_cosine > up * max_sine:
        share = up * max_sine / (max_cosine * sideways)
        forward, left = forward * share, left * share
    length = math.sqrt(forward * forward + left * left + up * up)
    # half-angle formulas, as in `Pose.facing`: no arctangent, so the same bits everywhere
    half = math.sqrt(0.5 + 0.5 * up / length)
    x, y = -left / (2 * half * length), forward / (2 * half * length)
    # the yaw times the tilt (half, x, y, 0)
    return Pose(pose.position, np.array([w * half, w * x - z * y, w * y + z * x, z * half]))


POINTS = 1000
"""Points drawn to find an end of a flight in a map."""
TRIES = 50
"""Flights tried for a single pose before the world counts as too narrow."""
