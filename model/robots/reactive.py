"""A robot without a map: it flies where the last scan leaves room, as near to the goal's direction
as can be, after the vector field histogram (Borenstein and Koren 1991), in three dimensions."""

import math

import numpy as np

from lidarsim.grid import Floats
from lidarsim.pose import rotate
from scenegen.fly.simulation import Observation
from scenegen.model.robots.steering import no_way, velocity_to

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

    def _free(self, ways: Floats, observation: Observation, most: float) -> Floats:
        """How far each of the ways (n, 3) is free, (n,) metres, `most` at most."""
        there = observation["points"][np.isfinite(observation["ranges"])].astype(np.float64)
        points = rotate(observation["quaternion"], there)
        squares = (points * points).sum(axis=1)
        points, squares = points[squares < HORIZON_M**2], squares[squares < HORIZON_M**2]
        along = ways @ points.T
        beside = squares - along * along
        wide = float(self._about["radius_m"]) + SPARE_M
        in_way = (along > 0) & (beside < wide * wide)
        free = np.where(in_way, along, most).min(axis=1, initial=most)
        edges = self._about["bounds"] - observation["position"]
        with np.errstate(divide="ignore", invalid="ignore"):
            out = np.where(ways > 0, edges[1] / ways, np.where(ways < 0, edges[0] / ways, np.inf))
        return np.minimum(free, out.min(axis=1) - SPARE_M + float(self._about["radius_m"]))
