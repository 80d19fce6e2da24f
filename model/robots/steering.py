"""From a direction, or a path, to a velocity; and a robot that steers by the last scan alone."""

import math
from collections.abc import Callable

import numpy as np

from lidarsim.grid import Floats, Mask
from lidarsim.pose import rotate
from lidarsim.scan import is_return
from scenegen.fly.simulation import Observation

AHEAD_M, AHEAD_S = 0.3, 0.4
"""The point of the path that is headed for: so far ahead, and so many seconds at the speed."""
MIN_AHEAD_M = 0.15
"""The least distance of the point that is headed for, metres."""
CUT_M = 0.2
"""Room beside the vehicle with which corners may be cut, metres."""
POINTS = 16
"""Points of the way ahead at which its room is measured."""
LAG_S = 0.3
"""How long it takes from a decision until the vehicle brakes or turns, without latency, seconds."""
SIDE_S = 0.2
"""The vehicle is so slow that it would take so many seconds to what is beside the way."""
SLOWEST_MPS = 0.5
"""Speed in the narrowest places, metres a second."""
STRAIGHT_M = 0.1
"""Room that it keeps from what lies straight ahead, metres."""
CREEP_MPS = 0.25
"""Speed towards what nothing has seen, metres a second: it would stop for ever otherwise."""
UNSEEN_STEP_M = 0.1
"""Distance of the points of a path at which it is looked up what has been seen, metres."""
TURN = 2.0
"""Rate of yaw for each radian off the course, 1/s."""


def lag_s(about: Observation) -> float:
    """Time from a decision until the vehicle brakes or turns, seconds."""
    return LAG_S + float(about["latency_s"])


def stopping_m(speed: float, about: Observation) -> float:
    """Length in which the vehicle stops from a speed, metres: it flies on for `LAG_S` and while the
    jerk builds up, and brakes with half of its acceleration, since it follows speeds that fall with
    a lag.

    Args:
        speed: Metres a second.
        about: See `Simulation.about`.
    """
    pull, jerk = float(about["acceleration_mps2"]), float(about["jerk_mps3"])
    return speed * (lag_s(about) + pull / jerk) + speed * speed / pull


def stopping_mps(length: float, about: Observation) -> float:
    """The speed from which the vehicle stops within a length, at least `CREEP_MPS`, m/s; see
    `stopping_m`.

    Args:
        length: Metres.
        about: See `Simulation.about`.
    """
    pull = float(about["acceleration_mps2"])
    lost = 0.5 * pull * (lag_s(about) + pull / float(about["jerk_mps3"]))
    return max(math.sqrt(lost * lost + pull * max(length, 0.0)) - lost, CREEP_MPS)


def velocity_to(
    direction: Floats, speed: float, observation: Observation, about: Observation
) -> Floats:
    """Fly in a direction, and turn to look there.

    Args:
        direction: (3,), world, of any length.
        speed: Metres a second.
        observation: See `Simulation.observe`.
        about: See `Simulation.about`.

    Returns:
        The action (4,).
    """
    fastest = math.radians(float(about["yaw_rate_deg_s"]))
    length = math.sqrt(float(direction @ direction))
    w, x, y, z = observation["quaternion"].tolist()
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    course = math.atan2(direction[1], direction[0])
    # nearly straight up or down, the course says little of where to look
    level = math.hypot(direction[0], direction[1]) > 0.2 * length
    turn = TURN * math.remainder(course - yaw, math.tau) if level else 0.0
    velocity = direction * (speed / max(length, 1e-9))
    return np.array([*velocity, min(max(turn, -fastest), fastest)])


def no_way(about: Observation) -> Floats:
    """The action (4,) of a robot that knows no way: it stops and looks around."""
    return np.array([0.0, 0.0, 0.0, math.radians(float(about["yaw_rate_deg_s"]))])


def follow(
    path: Floats,
    observation: Observation,
    about: Observation,
    room: Callable[[Floats], Floats],
    seen: Callable[[Floats], Mask] | None = None,
) -> Floats:
    """Follow a path: fly towards a point on it a little ahead.

    So slowly that the vehicle can brake for narrow places, the path's end, and obstacles straight
    ahead where the path turns. A corner is cut no nearer to an obstacle than the path goes, unless
    `CUT_M` is left beside the vehicle.

    Args:
        path: (n, 3) from the vehicle on, world, metres.
        observation: See `Simulation.observe`.
        about: See `Simulation.about`.
        room: Function from points (n, 3) to distances from occupied voxels, (n,), metres.
        seen: Function from points (n, 3) to whether a ray has crossed their voxel or returned from
            it, (n,): the vehicle is never faster than it can stop before the first that none has.
            None if it does not brake for them.

    Returns:
        The action (4,).
    """
    fastest, pull = float(about["speed_mps"]), float(about["acceleration_mps2"])
    radius, (low, high) = float(about["radius_m"]), about["bounds"]
    speed = math.sqrt(float(observation["velocity"] @ observation["velocity"]))
    steps = np.diff(path, axis=0)
    ends = np.append(0.0, np.cumsum(np.sqrt((steps * steps).sum(axis=1))))
    left, brakes = float(ends[-1]), lag_s(about) * speed
    sight = brakes + speed * speed / pull + 0.5

    def next_points(length: float) -> Floats:
        way = np.linspace(0, length, POINTS)
        return np.stack([np.interp(way, ends, axis) for axis in path.T], axis=1)

    def spare(points: Floats) -> Floats:
        edges = np.minimum(points - low, high - points).min(axis=1)
        return np.minimum(room(points) - radius, edges)

    # nearer, until the straight line there is as free as the path: corners are not cut closer
    ahead = min(AHEAD_M + AHEAD_S * speed, left)
    while True:
        part = next_points(ahead)
        straight = np.linspace(part[0], part[-1], POINTS)
        clearance = min(float(room(part).min()), radius + CUT_M)
        if ahead <= MIN_AHEAD_M or room(straight).min() > clearance - 1e-6:
            break
        ahead *= 0.7
    look = min(sight, left)
    allowed = np.maximum(spare(next_points(look)) / SIDE_S, SLOWEST_MPS)
    way = np.maximum(np.linspace(-brakes, look - brakes, POINTS), 0)
    # v² = v_end² + 2 a s: the vehicle brakes with half of its acceleration
    target = float(np.sqrt(allowed**2 + pull * way).min())
    target = min(fastest, target, math.sqrt(pull * left) + 0.1)
    if seen is not None:
        along = np.arange(0.0, min(left, stopping_m(fastest, about) + radius), UNSEEN_STEP_M)
        unseen = ~seen(np.stack([np.interp(along, ends, axis) for axis in path.T], axis=1))
        if unseen.any():
            target = min(target, stopping_mps(float(along[unseen.argmax()]) - radius, about))
    if speed > SLOWEST_MPS:
        # the path may turn where the vehicle cannot: it flies straight on until it has braked
        along = np.linspace(0, sight, POINTS)
        straight = path[0] + along[:, None] * observation["velocity"] / speed
        met = spare(straight) < STRAIGHT_M
        if met.any():
            free = along[met.argmax()]
            target = min(target, max(math.sqrt(pull * max(free - brakes, 0.0)), SLOWEST_MPS))
    return velocity_to(part[-1] - path[0], target, observation, about)


HORIZON_M = 4.0
"""Returns beyond are not heeded, metres."""
SPARE_M = 0.15
"""Room beyond the vehicle's radius on the way, metres."""
STEADY = 0.4
"""What a radian off the former direction costs, where one off the goal's costs 1."""
CROWDED = 2.0
"""What it costs that a way is not free up to the horizon, times the share that is missing."""
UP, AROUND = np.radians(np.arange(-45, 46, 15.0)), np.radians(np.arange(0, 360, 5.0))


class ReactiveRobot:
    """Of directions all around, takes the one of least cost: angles to the goal and to the former
    direction, and how soon it is blocked."""

    def reset(self, about: Observation) -> None:
        """See `Robot.reset`."""
        self._about, self._former = about, np.zeros(3)
        up, around = (angles.reshape(-1, 1) for angles in np.meshgrid(UP, AROUND))
        parts = [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)]
        self._directions = np.concatenate(parts, axis=1)

    def act(self, observation: Observation) -> Floats:
        """See `Robot.act`."""
        about, radius = self._about, float(self._about["radius_m"])
        to_goal = observation["goal"] - observation["position"]
        left = math.sqrt(float(to_goal @ to_goal))
        aim = to_goal / max(left, 1e-9)
        # the goal's own direction lies between those of the grid
        ways = np.concatenate([self._directions, aim[None]])
        free = self._free(ways, observation, min(HORIZON_M, left + radius))
        angles = np.arccos(np.clip(ways @ aim, -1, 1))
        turned = np.arccos(np.clip(ways @ self._former, -1, 1))
        cost = angles + STEADY * turned + CROWDED * (1 - free / free.max(initial=1e-9))
        best = int(np.argmin(np.where(free > radius + SPARE_M, cost, np.inf)))
        room = float(free[best]) - radius
        if room <= SPARE_M:
            return no_way(about)
        self._former = ways[best]
        pull = 0.5 * float(about["acceleration_mps2"])
        speed = min(float(about["speed_mps"]), math.sqrt(2 * pull * room), math.sqrt(left) + 0.1)
        return velocity_to(ways[best], speed, observation, about)

    def _free(self, ways: Floats, observation: Observation, limit: float) -> Floats:
        """How far each of the ways (n, 3) is free, (n,) metres, up to `limit`."""
        returned = is_return(observation["ranges"], min_range_m=0.0)
        returns = observation["points"][returned].astype(np.float64)
        points = rotate(observation["quaternion"], returns)
        squares = (points * points).sum(axis=1)
        points, squares = points[squares < HORIZON_M**2], squares[squares < HORIZON_M**2]
        along = ways @ points.T
        offsets = squares - along * along
        wide = float(self._about["radius_m"]) + SPARE_M
        # a way is a cylinder of the vehicle's width and some room
        in_way = (along > 0) & (offsets < wide * wide)
        free = np.where(in_way, along, limit).min(axis=1, initial=limit)
        edges = self._about["bounds"] - observation["position"]
        # the bounds are walls, too, and no scan shows them; parallel ways never meet them
        with np.errstate(divide="ignore", invalid="ignore"):
            out = np.where(ways > 0, edges[1] / ways, np.where(ways < 0, edges[0] / ways, np.inf))
        return np.minimum(free, out.min(axis=1) - SPARE_M + float(self._about["radius_m"]))
