"""The simulation of one mission: observations, motion and collisions of the vehicle."""

import hashlib
import math
from collections import deque
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarsim import Pose, Sensor
from lidarsim.grid import Floats
from lidarsim.noise.chain import Noise
from lidarsim.noise.losses import Motion
from lidarsim.pose import chained, rotate
from scenegen.draw.draw import in_motion, scan_world
from scenegen.fly import PERIOD_S, Rules, Vehicle
from scenegen.fly.missions import Mission
from scenegen.fly.motion import (
    ACCELERATION,
    POSITION,
    STEP_S,
    STEPS,
    VELOCITY,
    Command,
    Quadrotor,
    advance,
    max_pull,
    pose_of,
)
from scenegen.fly.serve import numbers_of
from scenegen.worlds.clearance import MoversClearance
from scenegen.worlds.world import AnyWorld, World

Outcome = Literal["success", "collision", "struck", "left", "timeout", "crashed", "hung", "flooded"]
"""How a flight ended: at its goal; at a solid that stands; at a mover; beyond the flight bounds;
out of time; or its robot raised or died, did not answer, or wrote too much."""
HITS = ("collision", "struck")
"""Outcomes in which the vehicle touched something."""
Observation = dict[str, NDArray[Any]]
"""Arrays by name, see `Simulation.observe`."""
LARGEST = 1e6
"""Speeds beyond this are scaled down before their squares are summed, which could overflow."""
DRIFT = 1
"""Beside the seed of the noise, that of the drift."""
PRIZE = 10.0
"""Reward at the goal; its negative is that of any other end except a timeout."""


class Odometry:
    """The position and yaw that a robot is told. Their errors are random walks over the metres
    flown, and an error of the yaw also turns what is flown from then on.

    Args:
        start: (3,): where it begins, world metres; there it is exact.
        rules: Give the drift.
        seed: Seed of the walks.

    Attributes:
        position: What the robot is told, (3,), metres.
        yaw_rad: Error of the yaw that it is told.
    """

    def __init__(self, start: Floats, rules: Rules, seed: int):
        self.position, self.yaw_rad, self._rules = start.copy(), 0.0, rules
        self._rng = np.random.default_rng([seed, DRIFT])

    def move(self, motion: Floats) -> None:
        """Add a motion (3,), world metres."""
        x, y, z = motion.tolist()
        # numbers between -1 and 1 have a third of the variance asked for; bits are alike everywhere
        spread = math.sqrt(3 * math.sqrt(x * x + y * y + z * z) / 100)
        *along, turn = (spread * self._rng.uniform(-1, 1, 4)).tolist()
        self.yaw_rad += math.radians(self._rules.drift_deg) * turn
        self.position += self.turned(motion) + self._rules.drift_m * np.array(along)

    def turned(self, vector: Floats, sign: int = 1) -> Floats:
        """Turn a vector by the error of the yaw.

        Args:
            vector: (3,), in the world.
            sign: 1; or -1 to turn a vector of the robot's back to the world.

        Returns:
            (3,), as the robot takes it.
        """
        return rotate(Pose.level(np.zeros(3), sign * self.yaw_rad).quaternion, vector[None])[0]


@dataclass(eq=False)
class Simulation:
    """A vehicle on its mission. The same commands give the same bits on every machine, except with
    the dynamics of MuJoCo.

    Attributes:
        state: State now, (11,), see `scenegen.fly.motion`.
        time_s: Time flown, seconds.
        outcome: How the flight ended; None until then.
        states: All states so far, (STEPS, 11) for each period, cut at the flight's end.
        clearances_m: Distance of the centre from the nearest solid or mover at each state, capped
            at `scenegen.worlds.clearance.CAP_M`, metres.
    """

    world: AnyWorld
    mission: Mission
    _: KW_ONLY
    sensor: Sensor
    vehicle: Vehicle
    rules: Rules
    noise: Noise = field(default_factory=Noise)
    moving: bool = False
    """Whether each ray is cast from where the sensor is at the ray's time."""
    scans: int = 1
    """How many scans an observation holds: the last one, and those before it."""
    seed: int = 0
    """Seed of the noise."""

    def __post_init__(self) -> None:
        mission, self._clearance = self.mission, self.world.clearance
        movers = self.world.movers if isinstance(self.world, World) else None
        self._movers = None if movers is None else MoversClearance(movers)
        self._earlier = deque[Observation](maxlen=max(self.scans - 1, 0))
        east, north = (mission.goal[axis] - mission.start[axis] for axis in range(2))
        length = math.sqrt(east * east + north * north)
        # the vehicle starts facing its goal
        # a goal straight above or below has no direction
        facing = (east / length, north / length) if length else (1.0, 0.0)
        self.state = np.array([*mission.start, *([0.0] * 6), *facing])
        self.time_s, self.periods = 0.0, 0
        self.most_s = self.rules.patience * mission.shortest_m / self.vehicle.speed_mps
        self.outcome: Outcome | None = None
        self.states: list[Floats] = [self.state[None]]
        self.clearances_m = self._free(self.state[None, POSITION], np.zeros(1))
        self._digest: Any = hashlib.sha256()
        self._seen, self._turning = b"", 0.0
        by_mujoco = self.vehicle.dynamics == "mujoco"
        self._body = Quadrotor(self.state, self.vehicle) if by_mujoco else None
        # steps that decisions are late, and the last commands, latest first
        # less 1e-9: rounding must not add a step to a whole number of them
        late = math.ceil(self.rules.latency_s / STEP_S - 1e-9)
        self._late_periods, self._late_steps = divmod(late, STEPS)
        # two more than whole periods: a period begins by one command and ends by the next
        hover = [np.zeros(4, np.float32)] * (self._late_periods + 2)
        self._commands = deque(hover, maxlen=len(hover))
        drifts = self.rules.drift_m or self.rules.drift_deg
        self._odometry = Odometry(self.state[POSITION], self.rules, self.seed) if drifts else None

    @property
    def digest(self) -> str:
        """SHA-256 of all ranges and states so far.

        Raises:
            ValueError: This simulation was copied or pickled.
        """
        if self._digest is None:
            raise ValueError("a simulation that was copied or pickled has no digest")
        return str(self._digest.hexdigest())

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for copies and pickles, without the digest, which hashlib cannot copy
        to another process."""
        return vars(self) | {"_digest": None}

    @property
    def pose(self) -> Pose:
        """The body's pose in the world now, which a robot is told with the errors of odometry."""
        return self._body.pose if self._body else pose_of(self.state, self.vehicle)

    def about(self) -> Observation:
        """Return facts for the robot before it flies, all as float arrays.

        Returns:
            The fields of the vehicle; `goal` (3,) and `bounds` (2, 3), metres in the world;
            `reach_m`, the distance at which the goal is reached; `most_s`, the time limit;
            `period_s`, `latency_s`; and of the sensor `max_range_m`, `directions_body` (*shape,
            3), `times_s` and `lever_arm_m` (3,).
        """
        facts = vars(self.vehicle) | {
            "goal": self.mission.goal,
            "bounds": self.mission.bounds,
            "reach_m": self.rules.reach_m,
            "most_s": self.most_s,
            "period_s": PERIOD_S,
            "latency_s": self.rules.latency_s,
            "max_range_m": self.sensor.max_range_m,
            "directions_body": self.sensor.directions_body,
            "times_s": self.sensor.times_s,
            # a sensor of a user's own may have none
            "lever_arm_m": getattr(self.sensor, "lever_arm_m", ()) or (0.0, 0.0, 0.0),
        }
        # `dynamics` is not a number, and a real robot would not know it
        # arrays of the caller's own: the sensor's directions belong to all flights
        return {name: np.array(value, float) for name, value in facts.items() if name != "dynamics"}

    def observe(self) -> Observation:
        """Scan the world and return what the robot observes.

        Returns:
            `ranges` (*sensor.shape), metres, inf where nothing returned; `points`
            (*sensor.shape, 3), metres from the body along its axes, 0 where nothing returned;
            `position` (3,), `quaternion` (4,), w x y z, and `velocity` (3,) of the body in the
            world, metres and m/s, with the errors of the odometry; `goal` (3,), world metres;
            `time_s` (1,). With n = `scans` - 1 above 0 also the scans before, the latest first:
            `earlier_ranges` (n, *sensor.shape), `earlier_position` (n, 3), `earlier_quaternion`
            (n, 4) and `earlier_time_s` (n, 1); at the begin of a flight, the oldest one again.

        Raises:
            GenerationError: The noise does not fit the world.
        """
        pose, chain = self.pose, self.noise
        if self.moving:  # the motion at the scan's begin, taken as even during it
            forward, left, up = rotate(pose.back, self.state[None, VELOCITY])[0].tolist()
            turning = math.degrees(self._turning)
            pace: Any = Motion(
                forward_mps=forward, left_mps=left, up_mps=up, yaw_rate_deg_s=turning
            )
            chain = in_motion(pace, chain)
        # a ray that is cast at its own time meets movers at that time
        times_s = self.time_s + (self.sensor.times_s if self.moving else 0.0)
        # by the period: noise does not depend on which earlier scans were cast
        seed = [self.seed, self.periods]
        seen = scan_world(self.world, self.sensor, pose, chain, seed=seed, time_s=times_s)
        ranges = seen.ranges[0].astype(np.float32)
        self._seen = ranges.tobytes()
        hit = np.isfinite(ranges)
        points = np.zeros((*ranges.shape, 3))
        points[hit] = pose.to_body(seen.points())
        velocity = self.state[VELOCITY].copy()
        if self._odometry:
            turn = Pose.level(np.zeros(3), self._odometry.yaw_rad)
            attitude = chained(turn, Pose(np.zeros(3), pose.quaternion)).quaternion
            pose = Pose(self._odometry.position.copy(), attitude)
            velocity = self._odometry.turned(velocity)
        scan = {
            "ranges": ranges,
            # copies, which are the robot's to change
            "position": pose.position.copy(),
            "quaternion": pose.quaternion.copy(),
            "time_s": np.array([self.time_s]),
        }
        while len(self._earlier) < self.scans - 1:
            self._earlier.append(scan)
        before = {
            f"earlier_{name}": np.stack([one[name] for one in self._earlier])
            for name in scan
            if self._earlier
        }
        self._earlier.appendleft(scan)
        return {
            **scan,
            "points": points.astype(np.float32),
            "velocity": velocity,
            "goal": np.array(self.mission.goal),
            **before,
        }

    def step(self, command: Command) -> float:
        """Fly one period, or until the flight ends.

        Collisions between steps are found to a millimetre: if a step is longer than the clearance
        before it, its chord is checked; among movers, every chord is, with movers where they are
        when the vehicle is there. A step strays from its chord by at most a t² / 8, which is added
        to the radius.

        Args:
            command: A command (4,) from `bounded`.

        Returns:
            The reward: the decrease of the distance to the goal, metres, plus `PRIZE` at the goal
            and minus `PRIZE` at a collision or beyond the bounds.
        """
        before_m, vehicle = self._left_m(), self.vehicle
        low, high = np.array(self.mission.bounds)
        if self._odometry:
            velocity = self._odometry.turned(command[:3].astype(float), -1)
            command = np.array([*velocity, command[3]], np.float32)
        self._commands.appendleft(command)
        states, pull = (
            self._states_of_period(),
            self._body.max_pull if self._body else max_pull(vehicle),
        )
        stray = pull * STEP_S * STEP_S / 8
        radius = vehicle.radius_m + stray
        self._turning = float(self._commands[self._late_periods][3])
        position: Any = tuple(self.state[POSITION].tolist())
        free, flown, now_s = self.clearances_m[-1], len(states), self.time_s
        positions = states[:, POSITION]
        times_s = now_s + np.arange(1.0, flown + 1.0) * STEP_S
        clearances_m = self._free(positions, times_s)
        beyond = ((positions < low) | (positions > high)).any(axis=1).tolist()
        for number, at in enumerate(positions.tolist(), start=1):
            next_position = tuple(at)
            if math.dist(
                position, next_position
            ) >= free - radius and not self._clearance.motion_is_free(
                position, next_position, radius
            ):
                self.outcome = "collision"
            elif self._movers and not self._movers.motion_is_free(
                position, next_position, (now_s, now_s + STEP_S), radius
            ):
                self.outcome = "struck"
            elif beyond[number - 1]:
                self.outcome = "left"
            elif math.dist(next_position, self.mission.goal) <= self.rules.reach_m:
                self.outcome = "success"
            now_s = self.time_s + number * STEP_S
            position, free = next_position, clearances_m[number - 1]
            self.clearances_m.append(free)
            if self.outcome is not None:
                flown = number
                break
        self.states.append(states[:flown])
        # what was seen counts, too: noise or a sensor may differ while the robot flies the same
        if self._digest is not None:
            self._digest.update(self._seen + states[:flown].tobytes())
        if self._odometry:
            self._odometry.move(states[flown - 1, POSITION] - self.state[POSITION])
        self.state = states[flown - 1]
        self.periods += 1
        # from whole counts, so that rounding errors do not add up
        self.time_s = (self.periods - 1) * PERIOD_S + flown * STEP_S
        prize = 0.0 if self.outcome is None else PRIZE if self.outcome == "success" else -PRIZE
        # after the prize, since a timeout costs nothing
        if self.outcome is None and self.time_s >= self.most_s:
            self.outcome = "timeout"
        return before_m - self._left_m() + prize

    def _states_of_period(self) -> Floats:
        """States (STEPS, 11) of a period: first by the command that is still followed."""
        state, parts = self.state, []
        late, periods = self._late_steps, self._late_periods
        for steps, command in ((late, periods + 1), (STEPS - late, periods)):
            if steps:
                given = self._commands[command]
                parts.append(
                    self._body.advance(given, steps)
                    if self._body
                    else advance(state, given, self.vehicle, steps)
                )
                state = parts[-1][-1]
        return np.concatenate(parts)

    def _free(self, points: Floats, times_s: Floats) -> list[float]:
        """Distances of points (n, 3) from the nearest solid, or mover at their times (n,), metres,
        at most `CAP_M`."""
        free = self._clearance.at_all(points)
        if self._movers is not None:
            free = np.minimum(free, self._movers.at(points, times_s))
        return list(free.tolist())

    def _left_m(self) -> float:
        return math.dist(self.state[POSITION], self.mission.goal)

    def measured(self) -> dict[str, float]:
        """Return figures of the flight so far, see `Flown`: `flown_m`, `speed_mps`,
        `min_clearance_m`, `mean_clearance_m` and `jerk_mps3`."""
        states = np.concatenate(self.states)
        steps = np.diff(states[:, POSITION], axis=0)  # chords: steps are 6 ms long
        flown = float(np.sqrt((steps * steps).sum(axis=1)).sum())
        jerk = np.diff(states[:, ACCELERATION], axis=0) / STEP_S
        return {
            "flown_m": flown,
            # a robot may fail before its first step
            "speed_mps": flown / max(self.time_s, STEP_S),
            "min_clearance_m": min(self.clearances_m),
            "mean_clearance_m": float(np.mean(self.clearances_m)),
            "jerk_mps3": math.sqrt(float((jerk * jerk).sum() / max(len(jerk), 1))),
        }


def bounded(action: Any, vehicle: Vehicle) -> tuple[Command | None, bool]:
    """Turn a robot's action into commands within the vehicle's bounds.

    Args:
        action: Velocity in the world, m/s, and yaw rate, rad/s, (4,); or those of up to ten
            periods, (n, 4).
        vehicle: Bounds of the commands.

    Returns:
        Commands (n, 4), or None if `action` is not an array of finite numbers of this shape; and
        whether a bound was exceeded by more than rounding.
    """
    numbers = numbers_of(action)
    if numbers is None or not np.isfinite(numbers).all():
        return None, False
    rows = np.atleast_2d(numbers)  # a single command is a plan of one period
    if rows.ndim != 2 or rows.shape[1] != 4 or not 1 <= len(rows) <= 10:
        return None, False
    rows[:, :3] *= LARGEST / np.maximum(np.abs(rows[:, :3]).max(axis=1, keepdims=True), LARGEST)
    # rounding to float32 must not lead out of the bounds again
    max_speed, turn = (
        vehicle.speed_mps * (1 - 1e-6),
        math.radians(vehicle.yaw_rate_deg_s) * (1 - 1e-6),
    )
    speed = np.sqrt((rows[:, :3] ** 2).sum(axis=1))
    exceeds = bool(
        (speed > vehicle.speed_mps + 1e-3).any() or (abs(rows[:, 3]) > turn + 1e-3).any()
    )
    rows[:, :3] *= np.minimum(1.0, max_speed / np.maximum(speed, 1e-9))[:, None]
    rows[:, 3] = np.clip(rows[:, 3], -turn, turn)
    return rows.astype(np.float32), exceeds
