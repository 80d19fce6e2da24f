"""Flights as a Gymnasium environment."""

import dataclasses
import math
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces

from scenegen.fly.course import Course
from scenegen.fly.motion import Command
from scenegen.fly.simulation import Observation, Simulation, bounded


class Flight(gymnasium.Env[Observation, Command]):
    """A quadrotor with a LiDAR flies to a goal: `gymnasium.make("scenegen/Fly-v0")`.

    An observation is that of `Simulation.observe`; an action is a velocity in the world, m/s, and
    a rate of yaw, rad/s, (4,), flown for a tenth of a second; or those of several `periods` to
    come, (periods, 4), flown one after the other before the next observation. The reward is how
    many metres nearer the goal is, and 10 at the goal, -10 at a collision or beyond the bounds.
    Each episode has a world of its own, drawn by the environment's generator, or, of a file, a
    mission of its own.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(
        self,
        world: str = "pillar",
        *,
        periods: int = 1,
        render_mode: Literal[None] = None,
        **options: Any,
    ):
        """`periods` is how many an action holds, 1 to 10; `world`, and further `options`, are those
        of `scenegen.fly.course.Course`, but for `seed` and `flights`: `reset` has the seed.

        Raises ScenegenError for a world, a sensor or noise that cannot be, and for a world that is
        too narrow.
        """
        if not 1 <= periods <= 10:
            raise ValueError(f"periods = {periods}: expected 1 to 10")
        self._course = Course(world=world, seed=0, flights=1, **options)
        self.render_mode, vehicle = render_mode, self._course.vehicle
        turn = math.radians(vehicle.yaw_rate_deg_s)
        high = np.array([*[vehicle.speed_mps] * 3, turn], np.float32)
        if periods > 1:
            high = np.tile(high, (periods, 1))
        self.action_space = spaces.Box(-high, high, dtype=np.float32)
        # of a flight that may begin, so that what cannot be is told now
        self.observation_space = spaces.Dict(
            {
                name: spaces.Box(-np.inf, np.inf, part.shape, part.dtype.type)
                for name, part in self._course.simulation(0).observe().items()
            }
        )
        self._flying: Simulation | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A new mission; `options` may have its course's `seed`, which else is drawn, and another
        `world` and `difficulty` than the environment's."""
        super().reset(seed=seed)
        about = {"seed": int(self.np_random.integers(2**31))} | (options or {})
        if odd := about.keys() - {"seed", "world", "difficulty"}:
            raise ValueError(f"options: {', '.join(odd)}: expected seed, world, difficulty")
        course = dataclasses.replace(self._course, **about)
        self._flying = course.simulation(0)
        return self._flying.observe(), {"seed": course.seed, "about": self._flying.about()}

    def step(self, action: Command) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Fly an action, or its first periods if the flight ends there. `info` has the `outcome`
        once there is one."""
        flying = self._flying
        assert flying is not None, "reset comes first"
        commands, _ = bounded(action, flying.vehicle)
        if commands is None or np.shape(action) != self.action_space.shape:
            raise ValueError(
                f"action = {action!r}: expected finite numbers, {self.action_space.shape}"
            )
        reward = 0.0
        for command in commands:
            if flying.outcome is None:
                reward += flying.step(command)
        ended = flying.outcome not in (None, "timeout")
        info = {"outcome": flying.outcome} if flying.outcome else {}
        return flying.observe(), reward, ended, flying.outcome == "timeout", info
