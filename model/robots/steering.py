"""From a path to a velocity."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scenegen.fly.simulation import Observation

AHEAD_M, AHEAD_S = 0.3, 0.4
"""The point of the path that is headed for: so far ahead, and so many seconds at the speed."""
LEAST_AHEAD_M = 0.15
"""The nearest that it is."""
CUT_M = 0.2
"""Room beside the vehicle with which corners may be cut, metres."""
POINTS = 8
"""At which a way and the short cut are compared."""
LOOK_M = 1.5
"""How far ahead the vehicle heeds how narrow the way is, metres."""
SLOW_M = 0.6
"""Where less than this is free beside the vehicle, it flies slower, metres."""
LEAST = 0.25
"""Of the full speed, that which is flown at least."""
TURN = 2.0
"""Rate of yaw for each radian off the course, 1/s."""


def velocity_to(
    direction: NDArray[np.float64], speed: float, observation: Observation, about: Observation
) -> NDArray[np.float64]:
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


def no_way(about: Observation) -> NDArray[np.float64]:
    """The action (4,) of a robot that knows no way: it stops and looks around."""
    return np.array([0.0, 0.0, 0.0, math.radians(float(about["yaw_rate_deg_s"]))])


def follow(
    path: NDArray[np.float64],
    observation: Observation,
    about: Observation,
    room: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """The action (4,) that follows a path (n, 3), world metres, from the vehicle on: towards a
    point on it a little ahead, slower where it is narrow and where the path ends.

    `room` tells how far points (n, 3) are from what is taken for occupied, (n,) metres. A corner
    is cut no nearer to it than the path goes, unless `CUT_M` is left beside the vehicle.
    """
    most, pull = float(about["speed_mps"]), float(about["acceleration_mps2"])
    radius = float(about["radius_m"])
    speed = math.sqrt(float(observation["velocity"] @ observation["velocity"]))
    steps = np.diff(path, axis=0)
    ends = np.append(0.0, np.cumsum(np.sqrt((steps * steps).sum(axis=1))))
    ahead = min(AHEAD_M + AHEAD_S * speed, float(ends[-1]))
    while True:
        way = np.linspace(0, ahead, POINTS)
        part = np.stack([np.interp(way, ends, axis) for axis in path.T], axis=1)
        straight = np.linspace(part[0], part[-1], POINTS)
        least = min(float(room(part).min()), radius + CUT_M)
        if ahead <= LEAST_AHEAD_M or room(straight).min() > least - 1e-6:
            break
        ahead *= 0.7
    near = path[(np.abs(path - path[0]) <= LOOK_M).all(axis=1)]
    wanted = most * min(max((float(room(near).min()) - radius) / SLOW_M, LEAST), 1.0)
    wanted = min(wanted, math.sqrt(pull * float(ends[-1])) + 0.1)
    return velocity_to(part[-1] - path[0], wanted, observation, about)
