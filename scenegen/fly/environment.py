"""Flights as a Gymnasium environment."""

import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from lidarsim.parameters import MAX_LENGTH_M, short_repr
from scenegen.base.errors import DatasetError, ScenegenError, check_int, reraise_as
from scenegen.fly.course import Course
from scenegen.fly.motion import Command
from scenegen.fly.simulation import Observation, Simulation, bounded
from scenegen.worlds.tables import check_name, field_names, from_table

NAME = "scenegen/Fly-v0"
MAX_PERIODS = 10
MAX_WORLDS = 4096
OPTIONS = tuple(sorted(field_names(Course) - {"world", "seed", "flights", "document", "level"}))
"""Fields of a course that are options of the environment; it sets the others itself."""
RESET_OPTIONS = ("seed", "world", "difficulty")


class FlightError(ScenegenError, ValueError):
    """The environment got a wrong argument, or was used out of order."""


class Flight(gymnasium.Env[Observation, Command]):
    """A quadrotor with a LiDAR flies to a goal: `gymnasium.make("scenegen/Fly-v0")`.

    An observation is that of `Simulation.observe`, except that `ranges` are the sensor's maximum
    range where nothing returned, so that all spaces are bounded. An action is a velocity in the
    world, m/s, and a yaw rate, rad/s, (4,), flown for a tenth of a second; or those of several
    `periods`, (periods, 4), flown one after the other before the next observation. The reward is
    the decrease of the distance to the goal, metres, plus 10 at the goal and minus 10 at a
    collision or beyond the bounds. Each episode draws a new world, or for a file, a new mission;
    with `worlds`, it takes one of so many.

    The environment can be copied and pickled; a copy continues exactly like the original.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(
        self,
        world: str | Path = "pillar",
        *,
        worlds: int = 0,
        periods: int = 1,
        render_mode: None = None,
        **options: Any,
    ):
        """Make the environment.

        Args:
            world: A kind of worlds, or a file: see `scenegen.fly.course.Course`.
            worlds: Number of worlds that episodes choose from: those of the seeds below it, each
                with one mission. They are drawn once and kept, for all environments of the process
                that are alike. 0: each episode draws a new world, which takes as long as some
                hundred steps.
            periods: Commands of an action, 1 to 10.
            render_mode: None: there are no pictures.
            options: Further fields of a `Course`, except `seed` and `flights`: `reset` has the
                seed.

        Raises:
            ScenegenError: An option is unknown, or of another type; there is no such world, sensor
                or noise; or the world is too narrow.
        """
        if render_mode is not None:
            raise FlightError(
                f"{NAME}: render_mode = {short_repr(render_mode)}: expected None; `scenegen "
                "fly world --film` draws flights"
            )
        with reraise_as(FlightError, of=DatasetError):
            periods = check_int(f"{NAME}: periods =", periods, 1, MAX_PERIODS)
            self._worlds = check_int(f"{NAME}: worlds =", worlds, 0, MAX_WORLDS)
        for name in options:
            check_name(name, ("world", "worlds", "periods", *OPTIONS), "option", NAME)
        world = str(world) if isinstance(world, Path) else world
        table = {"world": world, "seed": 0, "flights": 1} | options
        self._course: Course = from_table(Course, table, NAME, Path())
        self.render_mode = render_mode
        vehicle = self._course.vehicle
        turn = math.radians(vehicle.yaw_rate_deg_s)
        high = np.array([*[vehicle.speed_mps] * 3, turn], np.float32)
        if periods > 1:
            high = np.tile(high, (periods, 1))
        self.action_space = spaces.Box(-high, high, dtype=np.float32)
        # by a real simulation, so that a wrong world or sensor is refused here, not in `reset`
        self.observation_space = _space(self._course.simulation(0))
        boxes: Any = self.observation_space
        # all elements of an array have the same limits
        self._limits = {
            name: (box.low.flat[0], box.high.flat[0]) for name, box in boxes.spaces.items()
        }
        self._flying: Simulation | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin a new mission.

        Args:
            seed: Seeds the environment's generator.
            options: The `seed` of the course, which is drawn by default; another `world` and
                `difficulty` than the environment's.

        Returns:
            The first observation; and a dictionary with the course's `seed`, and in `about` the
            mission, see `Simulation.about`.

        Raises:
            ScenegenError: An option is unknown or not valid, or the world is too narrow.
        """
        super().reset(seed=seed)
        where = f"{NAME}: reset: options"
        if options is not None and not isinstance(options, Mapping):
            raise FlightError(f"{where} = {short_repr(options)}: expected a dictionary")
        table = {"seed": int(self.np_random.integers(self._worlds or 2**31))} | dict(options or {})
        for name in table:
            check_name(name, RESET_OPTIONS, "option", where)
        course: Course = from_table(self._course, table, where, Path())
        if course.seed < self._worlds:
            course = _kept(course)
        self._flying = course.simulation(0)
        return self._observed(), {"seed": course.seed, "about": self._flying.about()}

    def step(self, action: Command) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Fly an action, or its first periods if the flight ends there.

        Args:
            action: Of `action_space`; greater speeds are clipped.

        Returns:
            Observation, reward, whether the flight ended, whether its time is over, and a
            dictionary with its `outcome` once it ended.

        Raises:
            FlightError: No flight has begun, or `action` has another shape or is not finite.
        """
        flying = self._flying
        if flying is None or flying.outcome is not None:
            state = "none has begun" if flying is None else f"it ended: {flying.outcome}"
            raise FlightError(f"{NAME}: step: no flight is under way ({state}); call reset first")
        commands, _ = bounded(action, flying.vehicle)
        if commands is None or np.shape(action) != self.action_space.shape:
            raise FlightError(
                f"{NAME}: step: action = {short_repr(action)}: expected finite numbers, of shape "
                f"{self.action_space.shape}"
            )
        reward = 0.0
        for command in commands:
            if flying.outcome is None:
                reward += flying.step(command)
        # Gymnasium counts running out of time as a truncation, not an end
        ended = flying.outcome not in (None, "timeout")
        info: dict[str, Any] = {"outcome": flying.outcome} if flying.outcome else {}
        return self._observed(), reward, ended, flying.outcome == "timeout", info

    def render(self) -> None:
        """Refuse to render.

        Raises:
            FlightError: Always; there are no pictures.
        """
        raise FlightError(f"{NAME}: renders nothing; `scenegen fly world --film` draws flights")

    def _observed(self) -> Observation:
        """Return the observation, clipped to its space: inf becomes the maximum range."""
        assert self._flying is not None
        seen = self._flying.observe()
        return {name: np.clip(value, *self._limits[name]) for name, value in seen.items()}


@functools.lru_cache(maxsize=MAX_WORLDS)
def _kept(course: Course) -> Course:
    """Return the first course like this one, which holds its world and mission once they are
    drawn."""
    return course


def _space(simulation: Simulation) -> spaces.Dict:
    """Return the space of observations of any course with this sensor, vehicle and rules.

    Positions may be anywhere in the largest world, since `reset` may choose another world. The
    kinematic motion keeps the maximum speed; MuJoCo's may exceed it, hence twice that.
    """
    facts, speed = simulation.about(), simulation.vehicle.speed_mps
    range_m = float(facts["max_range_m"])
    reach_m = range_m + float(np.linalg.norm(facts["lever_arm_m"]))
    bounds = {
        "ranges": (0.0, range_m),
        "points": (-reach_m, reach_m),
        "position": (-MAX_LENGTH_M, MAX_LENGTH_M),
        "quaternion": (-1.0, 1.0),
        "velocity": (-2 * speed, 2 * speed),
        "goal": (-MAX_LENGTH_M, MAX_LENGTH_M),
        "time_s": (0.0, simulation.rules.patience * MAX_LENGTH_M / speed),
    }
    return spaces.Dict(
        {
            name: spaces.Box(*bounds[name.removeprefix("earlier_")], part.shape, part.dtype.type)
            for name, part in simulation.observe().items()
        }
    )
