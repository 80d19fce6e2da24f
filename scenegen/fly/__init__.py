"""Closed loop: a quadrotor with a LiDAR flies through a world to a goal, and a robot decides.

`missions` draws starts and goals, `motion` moves the quadrotor, `simulation` senses and finds
collisions, `loop` lets a robot fly and scores it. A robot may be a process of its own (`pipe`,
`serve`). `course` keeps flights and flies them again; `environment` is for Gymnasium.
"""

from dataclasses import dataclass
from typing import Literal

from lidarsim.parameters import Checked, number

SUITES = ("aerial-1",)
"""Courses that never change."""
PERIOD_S = 0.1
"""From one decision of the robot to the next, seconds."""


@dataclass(frozen=True, kw_only=True)
class Vehicle(Checked):
    """The quadrotor: a ball that may touch nothing, and what bounds its motion."""

    radius_m: float = number(0.3, above=0, below=1)
    """Radius of the ball, metres."""
    speed_mps: float = number(2.0, least=0.1, most=20)
    """The most speed, metres a second."""
    acceleration_mps2: float = number(4.0, least=0.1, most=50)
    """The most acceleration, metres a second squared."""
    jerk_mps3: float = number(30.0, least=1, most=1000)
    """The most jerk, metres a second cubed."""
    tilt_deg: float = number(30.0, above=0, most=80)
    """The most that it leans, degrees: no acceleration is greater than the sine of this times
    gravity, by which it leans less."""
    yaw_rate_deg_s: float = number(90.0, above=0, most=360)
    """The most that it turns, degrees a second."""
    dynamics: Literal["kinematic", "mujoco"] = "kinematic"
    """Whether it moves as these bounds say, or as a quadrotor of MuJoCo's that tracks such a
    motion: with inertia, rotors' lag and drag, and bits that are those of one machine."""


@dataclass(frozen=True, kw_only=True)
class Rules(Checked):
    """Which starts and goals are drawn, and when a flight ends."""

    apart_m: float = number(15.0, above=0, most=1000)
    """Least distance from start to goal, metres; half the flight bounds' diagonal where that is
    less, and a half or a quarter of it where no such pair is connected."""
    spare_m: float = number(0.3, least=0, most=1)
    """How much farther than its radius the vehicle is from all solids at start and goal, and from
    the flight bounds, metres; from these, a quarter of their extent where that is less."""
    reach_m: float = number(0.5, above=0, most=10)
    """A flight succeeds this near to its goal, metres."""
    patience: float = number(10.0, least=1, most=1000)
    """A flight ends after so many times the shortest way at full speed."""
