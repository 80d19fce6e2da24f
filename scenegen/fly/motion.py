"""How the quadrotor moves: velocities are followed with bounded acceleration and jerk, with the
same bits on every processor."""

import math

import numpy as np
from numpy.typing import NDArray

from lidarsim import Pose
from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats
from lidarsim.jit import kernel
from scenegen.fly import PERIOD_S, Vehicle
from scenegen.worlds.flight import GRAVITY, leaning

STEPS = 16
"""Steps of constant jerk from one decision to the next."""
STEP_S = PERIOD_S / STEPS
EAGER = 5.0
"""Acceleration for each metre a second that the velocity lacks, 1/s."""
POSITION, VELOCITY, ACCELERATION, HEADING = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 11)
"""Parts of a state (11,): metres, m/s, m/s² in the world; cosine and sine of the yaw."""


def most_pull(vehicle: Vehicle) -> float:
    """The most acceleration, metres a second squared, that neither bound forbids."""
    sine = float(sin_cos(math.radians(vehicle.tilt_deg))[0])
    return min(vehicle.acceleration_mps2, sine * GRAVITY)


def advance(state: Floats, command: NDArray[np.float32], vehicle: Vehicle) -> Floats:
    """The states (STEPS, 11) after each step of one period.

    A step's jerk is constant, so that it is integrated exactly. The velocity asked for is
    approached from the one at which the vehicle would be once it no longer accelerated; that one
    never leaves the ball of allowed speeds, and so neither does the speed, to a millimetre a
    second.

    Args:
        state: Now, (11,).
        command: Velocity in the world, m/s, and rate of yaw, rad/s, within the bounds, (4,).
        vehicle: What is bounded.
    """
    wanted = command.astype(np.float64)
    sine, cosine = sin_cos(wanted[3] * STEP_S)
    bounds = (vehicle.speed_mps, most_pull(vehicle), vehicle.jerk_mps3)
    states = np.empty((STEPS, len(state)))
    _advance(state, wanted, float(cosine), float(sine), bounds, states)
    return states


def pose_of(state: Floats, vehicle: Vehicle) -> Pose:
    """The body's pose, leaning as its acceleration takes."""
    level = Pose.facing(state[POSITION], state[HEADING])
    x, y, z = state[ACCELERATION].tolist()
    return leaning(level, (x, y, z), most_deg=vehicle.tilt_deg)


@kernel
def _shortened(x, y, z, most):
    """A vector, no longer than `most`."""
    length = math.sqrt(x * x + y * y + z * z)
    share = most / length if length > most else 1.0
    return np.array([share * x, share * y, share * z])


@kernel
def _settled(velocity, pull, jerk):
    """The velocity that is left when the acceleration `pull` has been brought to nought."""
    share = math.sqrt((pull * pull).sum()) / (2.0 * jerk)
    return velocity + share * pull


@kernel
def _advance(state, wanted, cosine, sine, bounds, states):
    speed, most, jerk = bounds
    position, velocity, pull = state[0:3].copy(), state[3:6].copy(), state[6:9].copy()
    x, y = state[9], state[10]
    h = STEP_S
    for n in range(len(states)):
        lack = EAGER * (wanted[:3] - _settled(velocity, pull, jerk))
        change = _shortened(lack[0], lack[1], lack[2], most) - pull
        change = _shortened(change[0], change[1], change[2], jerk * h)
        after = _settled(velocity + h * (pull + 0.5 * change), pull + change, jerk)
        if (after * after).sum() > speed * speed:
            change = _shortened(-pull[0], -pull[1], -pull[2], jerk * h)
        position += h * velocity + h * h * (0.5 * pull + change / 6.0)
        velocity += h * (pull + 0.5 * change)
        pull += change
        x, y = cosine * x - sine * y, sine * x + cosine * y
        length = math.sqrt(x * x + y * y)
        x, y = x / length, y / length
        states[n, 0:3], states[n, 3:6], states[n, 6:9] = position, velocity, pull
        states[n, 9], states[n, 10] = x, y
