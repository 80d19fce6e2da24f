"""What a robot's decision takes on one core: `LATENCY_S` of benchmarks/fly.py.

    python benchmarks/decisions.py                      # every robot; add it to the table there
    python benchmarks/decisions.py --robots optimistic "anywhere, brakes at 0.5" --flights 40

Robots fly courses of the suite, one flight each. The first decisions of a course, in which kernels
are compiled, are not among the figures. Time of the processor hardly depends on other work.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import fly as flights
import measuring
import numpy as np
from scoring import titled

from scenegen.base.executors import processor
from scenegen.fly.course import Course
from scenegen.fly.loop import fly
from scenegen.fly.motion import STEP_S
from scenegen.fly.suite import frozen_courses
from scenegen.model.robots.flights import robot_maker

FIGURES = ("mean, ms", "95 %", "longest", "mean by the clock", "95 %", "latency, s")
Times = tuple[float, float]
"""What a decision took, seconds: of the processor, and by the clock."""


class Options(measuring.Options):
    """Who flies, and how often."""

    robots: Sequence[str] = tuple(flights.LATENCY_S)
    flights: int = 20


class Timed:
    """A robot whose decisions are timed."""

    def __init__(self, robot: Any):
        self.robot, self.reset = robot, robot.reset
        self.times: list[Times] = []

    def act(self, observation: Any) -> Any:
        """Decide as the robot does."""
        begin, used = time.perf_counter(), time.process_time()
        action = self.robot.act(observation)
        self.times.append((time.process_time() - used, time.perf_counter() - begin))
        return action


def main() -> None:
    """Print a row of each robot."""
    given = measuring.parse(Options, robots=["reactive", "optimistic"], flights=1)
    every = frozen_courses("drawn")
    courses = [replace(one, flights=1) for one in every[:: len(every) // given.flights]]
    rows = []
    for name in given.robots:
        times = np.concatenate([times_of(name, one) for one in courses[: given.flights]])
        rows.append((f"`{name}`", row(times)))
        print(f"{name}: {len(times)} decisions: {', '.join(rows[-1][1])}", flush=True)
    print(f"{given.flights} flights each, {processor()}")
    print("\n".join(titled("## Decisions", FIGURES, rows)))


def times_of(name: str, course: Course) -> list[Times]:
    """What the decisions of a robot's flight took."""
    robot, weights, _, brakes = flights.parts(name)
    pilot = robot_maker(robot, weights, brakes)(course)
    pilot.reset(course.simulation(0).about())
    getattr(pilot, "rehearse", lambda: None)()
    timed = Timed(pilot)
    fly(course.simulation(0), timed)
    return timed.times


def row(times: np.ndarray) -> list[str]:
    """The cells of a robot."""
    (used, clock), (used_95, clock_95) = times.mean(axis=0), np.percentile(times, 95, axis=0)
    figures = used, used_95, times[:, 0].max(), clock, clock_95
    latency_s = math.ceil(used / STEP_S) * STEP_S
    return [*(f"{1e3 * one:.1f}" for one in figures), f"{latency_s:g}"]


if __name__ == "__main__":
    main()
