"""Closed loop: a robot steers a quadrotor with a LiDAR through a world to a goal.

`missions` draws starts and goals, `motion` moves the quadrotor, `simulation` senses and detects
collisions, `loop` lets a robot fly and scores the flight. A robot may run in another process
(`pipe`, `serve`). `course` writes and replays flights; `environment` is for Gymnasium.
"""

from dataclasses import dataclass
from typing import Literal

from lidarsim.parameters import Checked, number

SUITES = ("aerial-2",)
"""Names of the suites, whose courses never change."""
TRACKS = ("drawn", "unseen", "movers")
"""Tracks of the suite whose worlds everybody can draw; besides, it has `places` and `hidden`."""
PERIOD_S = 0.1
"""Time between decisions of the robot, seconds."""


@dataclass(frozen=True, kw_only=True)
class Vehicle(Checked):
    """The quadrotor: a ball that must not touch anything, with bounds on its motion."""

    radius_m: float = number(0.3, above=0, below=1)
    """Radius of the ball, metres."""
    speed_mps: float = number(2.0, minimum=0.1, maximum=20)
    """Maximum speed, metres a second."""
    acceleration_mps2: float = number(4.0, minimum=0.1, maximum=50)
    """Maximum acceleration, metres a second squared."""
    jerk_mps3: float = number(30.0, minimum=1, maximum=1000)
    """Maximum jerk, metres a second cubed."""
    tilt_deg: float = number(30.0, above=0, maximum=80)
    """Maximum tilt, degrees. It also bounds the acceleration, to gravity times its sine."""
    yaw_rate_deg_s: float = number(90.0, above=0, maximum=360)
    """Maximum yaw rate, degrees a second."""
    dynamics: Literal["kinematic", "mujoco"] = "kinematic"
    """"kinematic": exact motion within these bounds, with the same bits on every machine. "mujoco":
    a quadrotor simulated by MuJoCo tracks it; its bits differ between machines."""


@dataclass(frozen=True, kw_only=True)
class Rules(Checked):
    """Which starts and goals are drawn, when a flight ends, and what a robot has to put up with."""

    apart_m: float = number(15.0, above=0, maximum=1000)
    """Minimum distance from start to goal, metres; at most half the diagonal of the flight bounds.
    If no pair so far apart is connected, half or a quarter of it."""
    spare_m: float = number(0.3, minimum=0, maximum=1)
    """Clearance at start and goal beyond the vehicle's radius, from solids and from the flight
    bounds, metres; from the bounds at most a quarter of their extent."""
    detour: float = number(1.0, minimum=1, maximum=10)
    """Minimum length of the shortest way, as a multiple of the distance from start to goal."""
    berth_m: float = number(0.0, minimum=0, maximum=1)
    """Clearance of the shortest way beyond the vehicle's radius, metres."""
    reach_m: float = number(0.5, above=0, maximum=10)
    """A flight succeeds within this distance of its goal, metres."""
    patience: float = number(10.0, minimum=1, maximum=1000)
    """Time limit of a flight, as a multiple of the shortest way at full speed."""
    latency_s: float = number(0.0, minimum=0, maximum=1)
    """Time from a scan until the vehicle does what was decided on it, seconds: what the robot takes
    to compute. Rounded up to steps of 1/160 s."""
    drift_m: float = number(0.0, minimum=0, maximum=10)
    """Error of the robot's position: standard deviation along each axis after 100 m, metres. It
    adds up as a random walk, from 0 at the start."""
    drift_deg: float = number(0.0, minimum=0, maximum=90)
    """Error of the robot's yaw, likewise, degrees."""
