"""A long flight as a vehicle makes it: from goal to goal, at an even pace, round corners, and with
a bounded rate of turn."""

import math

import numpy as np
from ompl import geometric as og

from lidarsim import Pose
from lidarsim.grid import Floats
from scenegen.errors import GenerationError
from scenegen.logs import Cruise
from scenegen.worlds.flight import TRIES, Flight, connect, points_of
from scenegen.worlds.world import AnyWorld

STEPS = 10
"""Steps from scan to scan in which the heading is followed."""
FINE_M = 0.01
"""Steps in which the path is followed, metres."""
ROUNDS = 3
"""How often corners are cut: every time, new points halve the way from one corner to the next."""


def cruise_poses(world: AnyWorld, cruise: Cruise, period_s: float, *, seed: int) -> list[Pose]:
    """Level poses, `period_s` seconds apart, along a long random flight through a world.

    The flight joins paths of RRT whose corners are cut by B-spline subdivision where a `Flight`'s
    clearance allows (OMPL's `PathSimplifier`). It is then averaged over two radii of the robot, by
    a triangle, which moves no point by more than two thirds of the radius: a third of the clearance
    is kept.

    Raises:
        GenerationError: No flight fits.
    """
    flight, rng = Flight(), np.random.default_rng(seed)
    path = _tour(world, flight, cruise.length_m, rng=rng)
    ends = np.append(0.0, np.cumsum(np.sqrt((np.diff(path, axis=0) ** 2).sum(axis=1))))
    flown = np.arange(0.0, cruise.length_m, FINE_M)
    reach = round(2 * flight.robot_radius_m / FINE_M)
    weights = 1.0 - abs(np.arange(-reach, reach + 1)) / reach
    weights /= weights.sum()
    curve = np.stack(
        [
            np.convolve(np.pad(np.interp(flown, ends, axis), reach, "edge"), weights, "valid")
            for axis in path.T
        ],
        axis=1,
    )
    step_s = period_s / STEPS
    times = _times(curve, cruise)
    now = np.arange(0.0, times[-1], step_s)
    positions = np.stack([np.interp(now, times, axis) for axis in curve.T], axis=1)
    yaws = _followed(positions, math.radians(cruise.yaw_rate_deg_s) * step_s)
    return [Pose.level(positions[n], float(yaws[n])) for n in range(0, len(now), STEPS)]


def _times(curve: Floats, cruise: Cruise) -> Floats:
    """When each point (n, 3) of a curve, `FINE_M` apart, is passed, seconds (n,)."""
    bend = np.gradient(np.gradient(curve, FINE_M, axis=0), FINE_M, axis=0)
    pull = np.sqrt((bend**2).sum(axis=1))
    most = cruise.acceleration_mps2
    squares = np.minimum(cruise.speed_mps**2, most / np.maximum(pull, 1e-9))
    ramp = 2 * most * FINE_M * np.arange(len(squares))
    squares = np.minimum.accumulate(squares - ramp) + ramp  # speeding up
    squares = (np.minimum.accumulate((squares - ramp[::-1])[::-1]) + ramp)[::-1]  # slowing down
    return np.append(0.0, np.cumsum(FINE_M / np.sqrt(squares[:-1])))


def _tour(world: AnyWorld, flight: Flight, length_m: float, *, rng: np.random.Generator) -> Floats:
    """A collision-free path (n, 3) of that length at least, from goal to goal."""
    bounds = world.room(flight.robot_radius_m, flight.min_distance_m, rng=rng)
    apart = min(flight.min_distance_m, math.dist(*bounds) / 3)
    legs, flown, here, tries = list[Floats](), 0.0, None, 0
    while flown < length_m:
        if (tries := tries + 1) > TRIES * (100 + len(legs)):
            raise GenerationError(f"no flight of {length_m:g} m fits between the solids")
        goal = rng.uniform(bounds[0], bounds[1])
        if world.clearance.at(*goal) < flight.robot_radius_m:
            continue
        if here is None:
            here = goal
        if math.dist(here, goal) < apart:
            continue
        seed = int(rng.integers(1, 2**31))
        found = connect(world.clearance, bounds, flight, (here, goal), seed)
        if found is None:
            here = here if legs else None  # the start itself may be walled in
            continue
        information, leg = found
        simplifier = og.PathSimplifier(information)
        simplifier.reduceVertices(leg)
        simplifier.smoothBSpline(leg, ROUNDS)
        legs.append(points_of(leg))
        flown += leg.length()
        here = legs[-1][-1]
    return np.concatenate(legs)


def _followed(positions: Floats, most_rad: float) -> Floats:
    """Headings (n,), radians, that follow the course along positions (n, 3) by `most_rad` a step at
    most."""
    east, north = np.diff(positions[:, :2], axis=0, append=positions[-1:, :2]).T
    moves = np.hypot(east, north) > 1e-6
    yaws = np.empty(len(positions))
    yaw = float(np.arctan2(north, east)[np.argmax(moves)])
    for n, course in enumerate(np.arctan2(north, east).tolist()):
        if moves[n]:  # straight up, it looks as it did before
            yaw += max(-most_rad, min(most_rad, math.remainder(course - yaw, math.tau)))
        yaws[n] = yaw
    return yaws
