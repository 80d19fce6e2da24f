"""Flights: OMPL's RRT between a random start and goal, the viewpoints along the path, and how a
quadrotor leans there."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from lidarsim import Pose
from lidarsim.elementary import sin_cos
from lidarsim.parameters import MOST_LENGTH_M, check, number
from scenegen.errors import GenerationError
from scenegen.limits import (
    LEAST_DRAWN_M,
    MOST_CANDIDATES,
    MOST_DRAWN_M,
    MOST_FLIGHTS,
    MOST_ITERATIONS,
    MOST_VIEWPOINTS,
)
from scenegen.worlds.clearance import CAP_M, Clearance
from scenegen.worlds.mapping import Mapper

GRAVITY = 9.81
"""Metres a second squared."""
LEAST_THRUST = 0.5
"""The vertical part of the thrust, a share of what hovering takes, is never less."""


def acceleration(
    turns: NDArray[np.float64],
    ends_m: NDArray[np.float64],
    flown_m: float,
    *,
    speed_mps: float,
    settle_s: float,
) -> tuple[float, float, float]:
    """Acceleration, metres a second squared, `flown_m` along a path of straight legs that is flown
    at `speed_mps`.

    `turns` (n, 3) say how the direction, a unit vector, changes at the path's points, `ends_m` (n,)
    along it. Each change of velocity is spread over `settle_s` before and after, by a triangle:
    this is the second derivative of the path smoothed by that triangle.
    """
    total = [0.0, 0.0, 0.0]
    for turn, end in zip(turns.tolist(), ends_m.tolist(), strict=True):
        share = 1.0 - abs((flown_m - end) / speed_mps) / settle_s
        if share > 0.0:
            for axis in range(3):
                total[axis] += speed_mps * turn[axis] * share / settle_s
    return total[0], total[1], total[2]


def leaning(pose: Pose, pull: tuple[float, float, float], *, most_deg: float) -> Pose:
    """The level `pose` of a body that accelerates by `pull`, metres a second squared, as its thrust
    has it: turned the shortest way, so that its heading stays. It leans by `most_deg` at most."""
    up = max(GRAVITY + pull[2], LEAST_THRUST * GRAVITY)
    w, _, _, z = pose.quaternion.tolist()
    cosine, sine = w * w - z * z, 2 * w * z
    forward, left = cosine * pull[0] + sine * pull[1], cosine * pull[1] - sine * pull[0]
    sideways = math.sqrt(forward * forward + left * left)
    most_sine, most_cosine = (float(value) for value in sin_cos(math.radians(most_deg)))
    if sideways * most_cosine > up * most_sine:
        share = up * most_sine / (most_cosine * sideways)
        forward, left = forward * share, left * share
    length = math.sqrt(forward * forward + left * left + up * up)
    half = math.sqrt(0.5 + 0.5 * up / length)
    x, y = -left / (2 * half * length), forward / (2 * half * length)
    return Pose(pose.position, np.array([w * half, w * x - z * y, w * y + z * x, z * half]))


ou.noOutputHandler()


@dataclass(frozen=True, kw_only=True)
class Flight:
    """How a sensor flies through a world, and where along the way it scans."""

    robot_radius_m: float = number(0.3, above=0, below=CAP_M)
    """Clearance that every point of a flight keeps, metres."""
    altitude_m: tuple[float, float] = number(
        (1.5, 5.0), least=-MOST_DRAWN_M, most=MOST_DRAWN_M, rising=True
    )
    """Heights between which flights keep, metres; a world from an MJCF file brings its own
    bounds."""
    margin_m: float = number(8.0, least=0, most=MOST_DRAWN_M)
    """How far flights keep from a drawn world's lateral edges, metres: half a map, so that maps lie
    in the world."""
    min_distance_m: float = number(10.0, least=0, most=MOST_LENGTH_M)
    """Least distance between start and goal, metres; a third of the flight bounds' diagonal where
    that is less."""
    viewpoints: int = number(5, least=1, most=MOST_VIEWPOINTS)
    """Samples a flight gives."""
    spacing_m: float = number(1.0, least=LEAST_DRAWN_M, most=MOST_LENGTH_M)
    """Least distance between two viewpoints of a flight, metres."""
    iterations: int = number(2000, least=1, most=MOST_ITERATIONS)
    """Iterations after which RRT gives up."""
    step_m: float = number(3.0, least=LEAST_DRAWN_M, most=MOST_LENGTH_M)
    """Longest edge of the RRT, metres."""
    goal_tolerance_m: float = number(0.5, least=LEAST_DRAWN_M, most=MOST_LENGTH_M)
    """How near to its goal a flight must end, metres."""
    flights_per_world: int = number(3, least=1, most=MOST_FLIGHTS)
    """Flights tried in one drawn world before it is rejected."""

    def __post_init__(self) -> None:
        check(self)
        if self.altitude_m[0] == self.altitude_m[1]:
            raise ValueError(
                f"altitude_m = {list(self.altitude_m)}: expected [low, high] in metres, low < high"
            )

    def bounds(self, size_m: tuple[float, float, float]) -> NDArray[np.float64]:
        """The box (2, 3) in which flights through a drawn world of extent `size_m` keep.

        Raises ValueError where the margin leaves none.
        """
        low, high = self.altitude_m
        box = np.array(
            [
                [self.margin_m, self.margin_m, low],
                [size_m[0] - self.margin_m, size_m[1] - self.margin_m, high],
            ]
        )
        if not (box[0] < box[1]).all():
            raise ValueError(
                f"[flight] margin_m = {self.margin_m}: leaves no room to fly in a world of "
                f"{list(size_m)} metres"
            )
        return box


def plan(
    clearance: Clearance, bounds: NDArray[np.float64], flight: Flight, *, rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """One collision-free path (n, 3) in world metres between a random start and goal in `bounds`
    (2, 3), or None.

    RRT (LaValle 1998) as OMPL has it. The same `rng` state gives the same path: OMPL's own
    generator is seeded from it before a fresh planner is made, and the search ends on a count of
    iterations, never on time.
    """
    ends = _start_and_goal(clearance, bounds, flight, rng=rng)
    seed = int(rng.integers(1, 2**31))
    if ends is None:
        return None
    ou.RNG.setSeed(seed)
    space = ob.RealVectorStateSpace(3)
    box = ob.RealVectorBounds(3)
    for axis in range(3):
        box.setLow(axis, float(bounds[0, axis]))
        box.setHigh(axis, float(bounds[1, axis]))
    space.setBounds(box)
    information = ob.SpaceInformation(space)
    information.setStateValidityChecker(
        lambda state: True
    )  # motions are checked whole, their ends included
    information.setMotionValidator(_Motions(information, clearance, flight.robot_radius_m))
    information.setup()
    problem = ob.ProblemDefinition(information)
    states = space.allocState(), space.allocState()
    for state, point in zip(states, ends, strict=True):
        for axis in range(3):
            state[axis] = float(point[axis])
    problem.setStartAndGoalStates(*states, flight.goal_tolerance_m)
    planner = og.RRT(information)
    planner.setRange(flight.step_m)
    planner.setProblemDefinition(problem)
    planner.setup()
    rounds = iter(range(flight.iterations))
    status = planner.solve(ob.PlannerTerminationCondition(lambda: next(rounds, None) is None))
    if status.getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    return np.array(
        [[state[0], state[1], state[2]] for state in problem.getSolutionPath().getStates()]
    )


class _Motions(ob.MotionValidator):
    """OMPL's edge check by `Clearance.motion_is_free`: one call an edge, to a millimetre between
    its ends."""

    def __init__(self, information: ob.SpaceInformation, clearance: Clearance, radius_m: float):
        super().__init__(information)
        self._clearance = clearance
        self._radius_m = radius_m

    def checkMotion(self, a: ob.State, b: ob.State, last_valid: object = None) -> bool:  # noqa: N802 (OMPL's name)
        return self._clearance.motion_is_free(
            (a[0], a[1], a[2]), (b[0], b[1], b[2]), self._radius_m
        )


def _start_and_goal(
    clearance: Clearance, bounds: NDArray[np.float64], flight: Flight, *, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Two free points far enough apart, or None after a hundred draws."""
    apart = min(flight.min_distance_m, float(np.sqrt(((bounds[1] - bounds[0]) ** 2).sum())) / 3)
    start = None
    for point in rng.uniform(bounds[0], bounds[1], (100, 3)):
        if clearance.at(*point) < flight.robot_radius_m:
            continue
        if start is None:
            start = point
        elif ((point - start) ** 2).sum() >= apart * apart:
            return start, point
    return None


@dataclass(frozen=True, eq=False)
class Route:
    """A path of straight legs, (n, 3) world metres, by the metres flown along it."""

    path: NDArray[np.float64]

    @cached_property
    def legs(self) -> NDArray[np.float64]:
        """(n - 1, 3): from each point to the next, metres."""
        return np.diff(self.path, axis=0)

    @cached_property
    def lengths(self) -> NDArray[np.float64]:
        """(n - 1,): of the legs, metres."""
        return np.sqrt((self.legs**2).sum(axis=1))

    @cached_property
    def ends(self) -> NDArray[np.float64]:
        """(n,): metres flown at each point."""
        return np.concatenate([[0.0], np.cumsum(self.lengths)])

    @cached_property
    def headings(self) -> NDArray[np.float64]:
        """(n - 1, 2): x and y of the legs; where one climbs straight up, the body looks as it did
        before."""
        legs = self.legs
        level = np.sqrt(legs[:, 0] * legs[:, 0] + legs[:, 1] * legs[:, 1]) > 1e-6
        turned = np.maximum.accumulate(np.where(level, np.arange(len(legs)), 0))
        return np.asarray(np.where(level[:, None], legs[:, :2], (1.0, 0.0))[turned])

    @cached_property
    def turns(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How the direction of flight changes at each point, its begin and end included, (k, 3),
        and the metres flown there, (k,)."""
        there = self.lengths > 0.0
        direction = self.legs[there] / self.lengths[there, None]
        still = np.zeros((1, 3))
        return np.diff(np.concatenate([still, direction, still]), axis=0), self.ends[
            np.append(there, True)
        ]

    def at(self, flown_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions (m, 3) and headings (m, 2) at `flown_m` (m,)."""
        leg = np.minimum(np.searchsorted(self.ends, flown_m, side="right") - 1, len(self.legs) - 1)
        along = (flown_m - self.ends[leg]) / self.lengths[leg]
        return self.path[leg] + along[:, None] * self.legs[leg], self.headings[leg]

    def pose(self, flown_m: float, mapping: Mapper) -> Pose:
        """The body's pose at `flown_m`, level, or leaning as `mapping` has it."""
        positions, headings = self.at(np.array([flown_m]))
        level = Pose.facing(positions[0], headings[0])
        if not mapping.tilt_mps:
            return level
        pull = acceleration(
            *self.turns, flown_m, speed_mps=mapping.tilt_mps, settle_s=mapping.settle_s
        )
        return leaning(level, pull, most_deg=mapping.most_tilt_deg)


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Places along a flight where the sensor could scan: m of them, in the order in which to try
    them."""

    flown_m: NDArray[np.float64]
    """(m,): metres flown from the start."""
    positions: NDArray[np.float64]
    """(m, 3): world metres."""
    headings: NDArray[np.float64]
    """(m, 2): world x and y, of any length; the body is level and looks along the flight."""
    route: Route

    def __len__(self) -> int:
        return len(self.flown_m)

    def pose(self, n: int, mapping: Mapper | None = None) -> Pose:
        """The body's pose at viewpoint `n`, level unless `mapping` tilts it."""
        if mapping is not None and mapping.tilt_mps:
            return self.route.pose(float(self.flown_m[n]), mapping)
        return Pose.facing(self.positions[n], self.headings[n])

    def before(self, n: int, mapping: Mapper) -> list[Pose]:
        """The poses from which the earlier scans of viewpoint `n` are made, the last one first."""
        back = [mapping.scan_spacing_m * number for number in range(1, mapping.scans)]
        return [
            self.route.pose(max(float(self.flown_m[n]) - metres, 0.0), mapping) for metres in back
        ]


def viewpoints(
    path: NDArray[np.float64], spacing_m: float, *, rng: np.random.Generator
) -> Viewpoints:
    """Candidate viewpoints on a path (n, 3), `spacing_m` apart along it, in random order.

    Raises GenerationError where there would be more than `MOST_CANDIDATES`.
    """
    route = Route(path)
    ends = route.ends
    if ends[-1] > MOST_CANDIDATES * spacing_m:
        raise GenerationError(
            f"flight.spacing_m = {spacing_m}: more than {MOST_CANDIDATES} places to scan from on "
            f"a flight of "
            f"{ends[-1]:.0f} m; raise it"
        )
    flown = np.arange(rng.uniform(0.0, spacing_m), ends[-1], spacing_m)
    flown = flown[rng.permutation(len(flown))]
    return Viewpoints(flown, *route.at(flown), route)
