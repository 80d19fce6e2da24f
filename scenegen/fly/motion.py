"""Motion of the quadrotor: kinematic, following velocities with bounded acceleration and jerk, with
the same bits on every processor; or simulated by MuJoCo with mass, rotors and drag, tracking the
kinematic motion."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from lidarsim import Pose
from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats
from lidarsim.jit import kernel
from lidarsim.pose import rotate
from scenegen.fly import PERIOD_S, Vehicle
from scenegen.worlds.flight import GRAVITY, leaning

Command = NDArray[np.float32]
"""Velocity in the world, m/s, and yaw rate, rad/s: (4,), or (n, 4) for n periods."""

STEPS = 16
"""Steps of constant jerk in a period."""
STEP_S = PERIOD_S / STEPS
EAGER = 5.0
"""Gain of the acceleration by the error of the velocity, 1/s."""
POSITION, VELOCITY, ACCELERATION, HEADING = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 11)
"""Slices of a state (11,): metres, m/s and m/s² in the world; cosine and sine of the yaw."""


def max_pull(vehicle: Vehicle) -> float:
    """Return the maximum acceleration by both bounds, m/s²: its own, and that of the tilt."""
    # `math.sin` has other bits on other processors
    sine = float(sin_cos(math.radians(vehicle.tilt_deg))[0])
    return min(vehicle.acceleration_mps2, sine * GRAVITY)


def advance(state: Floats, command: Command, vehicle: Vehicle, steps: int = STEPS) -> Floats:
    """Return the states (steps, 11) after each step, by default of one period.

    Jerk is constant within a step, so that a step is integrated exactly. The controlled velocity is
    the one that remains once the acceleration has been brought to zero. It never leaves the ball of
    allowed speeds, and so neither does the speed, to a millimetre a second.

    Args:
        state: State now, (11,).
        command: Velocity in the world, m/s, and yaw rate, rad/s, within the bounds, (4,).
        vehicle: Bounds of the motion.
        steps: Number of steps.
    """
    target = command.astype(np.float64)
    sine, cosine = sin_cos(target[3] * STEP_S)
    bounds = (vehicle.speed_mps, max_pull(vehicle), vehicle.jerk_mps3)
    states = np.empty((steps, len(state)))
    _advance(state, target, float(cosine), float(sine), bounds, states)
    return states


def pose_of(state: Floats, vehicle: Vehicle) -> Pose:
    """Return the body's pose in the world, tilted by its acceleration.

    Args:
        state: The state, (11,).
        vehicle: Bounds of the tilt.
    """
    level = Pose.facing(state[POSITION], state[HEADING])
    x, y, z = state[ACCELERATION].tolist()
    return leaning(level, (x, y, z), max_deg=vehicle.tilt_deg)


@kernel
def _shortened(x, y, z, max_length):
    """Return the vector, scaled down to `max_length` if it is longer."""
    length = math.sqrt(x * x + y * y + z * z)
    share = max_length / length if length > max_length else 1.0
    return np.array([share * x, share * y, share * z])


@kernel
def _settled(velocity, pull, jerk):
    """Return the velocity once the acceleration `pull` has been brought to zero at this jerk."""
    share = math.sqrt((pull * pull).sum()) / (2.0 * jerk)
    return velocity + share * pull


# the same operations in the same order on every processor, so that flights have the same bits
@kernel
def _advance(state, target, cosine, sine, bounds, states):
    speed, max_pull, jerk = bounds
    now = state.copy()
    position, velocity, pull = now[0:3], now[3:6], now[6:9]
    x, y = state[9], state[10]
    h = STEP_S
    for n in range(len(states)):
        lack = EAGER * (target[:3] - _settled(velocity, pull, jerk))
        change = _shortened(lack[0], lack[1], lack[2], max_pull) - pull
        change = _shortened(change[0], change[1], change[2], jerk * h)
        after = _settled(velocity + h * (pull + 0.5 * change), pull + change, jerk)
        if (after * after).sum() > speed * speed:  # the speed would exceed its bound later on
            change = _shortened(-pull[0], -pull[1], -pull[2], jerk * h)
        position += h * velocity + h * h * (0.5 * pull + change / 6.0)
        velocity += h * (pull + 0.5 * change)
        pull += change
        x, y = cosine * x - sine * y, sine * x + cosine * y
        length = math.sqrt(x * x + y * y)
        x, y = x / length, y / length  # rounding errors would add up over a flight
        now[9], now[10] = x, y
        for k in range(len(now)):  # assigning to slices takes numba seconds to compile
            states[n, k] = now[k]


ARM_M, TORQUE_M = 0.12, 0.02
"""Distance of a rotor from the body's axes, and torque of a rotor per thrust, metres."""
MASS_KG, INERTIA = 1.0, (0.008, 0.008, 0.014)
"""Mass, kg, and moments of inertia, kg m², of a vehicle half a metre wide."""
MAX_THRUST = 2.0
"""Maximum thrust of all rotors, as a multiple of the weight."""
LAG_S = 0.03
"""Time constant of a rotor, seconds."""
SUBSTEPS = 2
"""Steps of MuJoCo in a step of the kinematic motion."""
STIFF, DAMPED = 6.0, 4.5
"""Gains of the acceleration by the errors of position and velocity, 1/s² and 1/s."""
TURN_STIFF, TURN_DAMPED = 200.0, 22.0
"""Gains of the torque by the errors of attitude and angular rate, 1/s² and 1/s."""
SIGNS = np.array([[1, 1, 1], [1, -1, -1], [-1, -1, 1], [-1, 1, -1]])
"""(4, 3): for each rotor its side along x and y, and the sign of its torque."""


def _model() -> mujoco.MjModel:
    """Compile the quadrotor: a free body in air, with rotors as actuators that lag."""
    sites = "".join(
        f'<site name="r{n}" pos="{ARM_M * x} {ARM_M * y} 0"/>' for n, (x, y, _) in enumerate(SIGNS)
    )
    max_force = MAX_THRUST * MASS_KG * GRAVITY / len(SIGNS)
    rotors = "".join(
        f'<general site="r{n}" gear="0 0 1 0 0 {TORQUE_M * turn}" ctrlrange="0 {max_force}" '
        f'ctrllimited="true" dyntype="filterexact" dynprm="{LAG_S}"/>'
        for n, (_, _, turn) in enumerate(SIGNS)
    )
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP_S / SUBSTEPS}" gravity="0 0 {-GRAVITY}" density="1.2" '
        f'viscosity="1.8e-5"/><worldbody><body><freejoint/><inertial pos="0 0 0" mass="{MASS_KG}" '
        f'diaginertia="{" ".join(map(str, INERTIA))}"/>{sites}</body></worldbody>'
        f"<actuator>{rotors}</actuator></mujoco>"
    )


class Quadrotor:
    """Tracks the kinematic motion by a geometric controller (Lee et al. 2010): thrust from the
    desired acceleration, torque from the attitude that this needs."""

    max_pull = (MAX_THRUST + 1) * GRAVITY
    """Maximum acceleration by thrust and weight, metres a second squared."""

    def __init__(self, state: Floats, vehicle: Vehicle):
        """Begin at rest and level.

        Args:
            state: State of the kinematic motion, (11,); position and yaw count.
            vehicle: Bounds of the kinematic motion.
        """
        self._leads, self._vehicle = state, vehicle
        self._model = _model()
        self._data = mujoco.MjData(self._model)
        level = Pose.facing(state[POSITION], state[HEADING])
        self._data.qpos[:] = *level.position, *level.quaternion
        # rotors lag: if they began at rest, the vehicle would drop
        self._data.act[:] = MASS_KG * GRAVITY / len(SIGNS)
        # from total thrust and three torques to the thrust of each rotor
        forces = np.column_stack([np.ones(4), SIGNS[:, 1], -SIGNS[:, 0], SIGNS[:, 2]])
        self._mix = np.linalg.inv(forces.T * [[1], [ARM_M], [ARM_M], [TORQUE_M]])

    @property
    def pose(self) -> Pose:
        """The body's pose now."""
        # copies, since MuJoCo overwrites its arrays at every step
        return Pose(self._data.qpos[:3].copy(), self._data.qpos[3:].copy())

    def advance(self, command: Command, steps: int = STEPS) -> Floats:
        """Follow a command; see `advance`.

        Args:
            command: Velocity in the world, m/s, and yaw rate, rad/s, (4,).
            steps: Number of steps.

        Returns:
            States (steps, 11) after each step. Their acceleration is that of thrust and weight,
            without drag.
        """
        leads = advance(self._leads, command, self._vehicle, steps)
        states = np.empty((steps, 11))
        for lead, state in zip(leads, states, strict=True):
            self._data.ctrl[:] = self._mix @ self._controls(lead)
            mujoco.mj_step(self._model, self._data, SUBSTEPS)
            x, _, up = self._axes()
            state[POSITION], state[VELOCITY] = self._data.qpos[:3], self._data.qvel[:3]
            state[ACCELERATION] = up * (self._data.act.sum() / MASS_KG) - [0, 0, GRAVITY]
            state[HEADING] = x[:2] / math.hypot(x[0], x[1])
        self._leads = leads[-1]
        return states

    def _axes(self) -> Floats:
        """Return the body's axes in the world, (3, 3), one a row."""
        return rotate(self._data.qpos[3:].copy(), np.eye(3))

    def _controls(self, lead: Floats) -> Floats:
        """Return thrust (N) and torques (N m), (4,), that lead to a state (11,)."""
        pull = lead[ACCELERATION] + STIFF * (lead[POSITION] - self._data.qpos[:3])
        pull += DAMPED * (lead[VELOCITY] - self._data.qvel[:3]) + [0, 0, GRAVITY]
        axes, up = self._axes(), pull / np.linalg.norm(pull)
        left = np.cross(up, [*lead[HEADING], 0.0])
        left /= np.linalg.norm(left)
        # the error of the attitude is the skew part of the turn from it to the desired one
        turned = axes @ np.column_stack([np.cross(left, up), left, up])
        lack = 0.5 * (turned - turned.T)
        error = np.array([lack[2, 1], lack[0, 2], lack[1, 0]])
        torque = INERTIA * (TURN_STIFF * error - TURN_DAMPED * self._data.qvel[3:])
        return np.array([MASS_KG * pull @ axes[2], *torque])
