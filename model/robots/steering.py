"""From a path to a velocity."""

import math
from collections.abc import Callable

import numpy as np

from lidarsim.grid import Floats
from scenegen.fly.simulation import Observation

AHEAD_M, AHEAD_S = 0.3, 0.4
"""The point of the path that is headed for: so far ahead, and so many seconds at the speed."""
LEAST_AHEAD_M = 0.15
"""The nearest that it is."""
CUT_M = 0.2
"""Room beside the vehicle with which corners may be cut, metres."""
POINTS = 16
"""Of the way ahead, at which its room is measured."""
LAG_S = 0.3
"""From a decision until the vehicle brakes or turns, seconds."""
SIDE_S = 0.2
"""The vehicle is so slow that it would take so many seconds to what is beside the way."""
SLOWEST_MPS = 0.5
"""What it flies in the narrowest places, metres a second."""
TURN = 2.0
"""Rate of yaw for each radian off the course, 1/s."""


def velocity_to(
    direction: Floats, speed: float, observation: Observation, about: Observation
) -> Floats:
    """The action (4,) that flies at `speed` along a `direction` (3,) of any length, and turns to
    look where it goes."""
    most = math.radians(float(about["yaw_rate_deg_s"]))
    length = math.sqrt(float(direction @ direction))
    w, x, y, z = observation["quaternion"].tolist()
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    course = math.atan2(direction[1], direction[0])
    level = math.hypot(direction[0], direction[1]) > 0.2 * length
    turn = TURN * math.remainder(course - yaw, math.tau) if level else 0.0
    velocity = direction * (speed / max(length, 1e-9))
    return np.array([*velocity, min(max(turn, -most), most)])


def no_way(about: Observation) -> Floats:
    """The action (4,) of a robot that knows no way: it stops and looks around."""
    return np.array([0.0, 0.0, 0.0, math.radians(float(about["yaw_rate_deg_s"]))])


def follow(
    path: Floats,
    observation: Observation,
    about: Observation,
    room: Callable[[Floats], Floats],
) -> Floats:
    """The action (4,) that follows a path (n, 3), world metres, from the vehicle on: towards a
    point on it a little ahead, so slowly that it can brake for narrow places and the path's end.

    `room` tells how far points (n, 3) are from what is taken for occupied, (n,) metres. A corner
    is cut no nearer to it than the path goes, unless `CUT_M` is left beside the vehicle.
    """
    most, pull = float(about["speed_mps"]), float(about["acceleration_mps2"])
    radius, (low, high) = float(about["radius_m"]), about["bounds"]
    speed = math.sqrt(float(observation["velocity"] @ observation["velocity"]))
    steps = np.diff(path, axis=0)
    ends = np.append(0.0, np.cumsum(np.sqrt((steps * steps).sum(axis=1))))

    def next_points(length: float) -> Floats:
        way = np.linspace(0, length, POINTS)
        return np.stack([np.interp(way, ends, axis) for axis in path.T], axis=1)

    ahead = min(AHEAD_M + AHEAD_S * speed, float(ends[-1]))
    while True:
        part = next_points(ahead)
        straight = np.linspace(part[0], part[-1], POINTS)
        least = min(float(room(part).min()), radius + CUT_M)
        if ahead <= LEAST_AHEAD_M or room(straight).min() > least - 1e-6:
            break
        ahead *= 0.7
    brakes = LAG_S * speed
    look = min(brakes + speed * speed / pull + 0.5, float(ends[-1]))
    points = next_points(look)
    wide = np.minimum(room(points) - radius, np.minimum(points - low, high - points).min(axis=1))
    allowed = np.maximum(wide / SIDE_S, SLOWEST_MPS)
    way = np.maximum(np.linspace(-brakes, look - brakes, POINTS), 0)
    wanted = float(np.sqrt(allowed**2 + pull * way).min())
    wanted = min(most, wanted, math.sqrt(pull * float(ends[-1])) + 0.1)
    return velocity_to(part[-1] - path[0], wanted, observation, about)
