"""The loop of a flight: a robot observes, decides, and moves; and its scores."""

import math
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from lidarsim.grid import Floats
from lidarsim.parameters import number
from scenegen.base.errors import ScenegenError
from scenegen.fly import PERIOD_S
from scenegen.fly.missions import progress
from scenegen.fly.motion import POSITION, Command
from scenegen.fly.simulation import Observation, Outcome, Simulation, bounded


class Robot(Protocol):
    """Decides where to fly. A user's own robot is a class with these two methods, made without
    arguments."""

    def reset(self, about: Observation) -> None:
        """Begin a flight; see `Simulation.about`."""
        ...

    def act(self, observation: Observation) -> Any:
        """Decide how to fly.

        Args:
            observation: See `Simulation.observe`.

        Returns:
            Velocity in the world, m/s, and yaw rate, rad/s, (4,); or a plan of up to ten periods,
            (n, 4), whose later rows are flown if the next answers are invalid.
        """
        ...


class RobotError(ScenegenError):
    """A robot failed during a flight; `outcome` says how."""

    def __init__(self, outcome: Outcome, text: str):
        super().__init__(text)
        self.outcome = outcome


@dataclass(frozen=True, kw_only=True)
class Flown:
    """One flight of a robot. Lengths and times count until it ended."""

    outcome: Outcome
    score: float
    """Score of BARN (Xiao et al. 2022): T* / clip(T, 2 T*, 8 T*) for a success, where T* is the
    time of the shortest way at full speed; else 0."""
    spl: float
    """Success weighted by path length (Anderson et al. 2018)."""
    time_s: float
    """Time flown, seconds."""
    ratio: float
    """Length flown over that of the shortest way."""
    shortest_m: float = number(above=0)
    """Length of the shortest way, metres."""
    blocked: bool
    """Whether a solid blocks the straight line from start to goal for the vehicle."""
    progress: float
    """Share of the shortest way that was gained when the flight ended; 1 for a success."""
    flown_m: float
    """Length flown, metres."""
    speed_mps: float
    """Mean speed, metres a second."""
    min_clearance_m: float
    """Minimum distance of the vehicle's centre from a solid or mover, capped at 1 m, metres."""
    mean_clearance_m: float
    """Mean of that distance over time, metres."""
    jerk_mps3: float
    """Root mean square of the jerk, metres a second cubed."""
    step_s: float
    """Mean wall-clock time of a decision, seconds."""
    most_step_s: float
    """Maximum of that time, seconds."""
    late: int = number(minimum=0)
    """Decisions that took longer than a period."""
    invalid: int = number(minimum=0)
    """Answers that were not an action: NaN, or of another shape."""
    speeding: int = number(minimum=0)
    """Answers beyond the vehicle's bounds, which were clipped."""
    digest: str
    """SHA-256 of all ranges and states."""
    trouble: str = ""
    """The error of a robot that failed."""
    commands: Command = field(repr=False)
    """(periods, 4): commands as flown, m/s and rad/s."""
    path: Floats = field(repr=False)
    """(n, 3): positions, one a period, metres in the world."""

    def row(self) -> dict[str, Any]:
        """Return all figures by name, without the arrays."""
        return {name: value for name, value in vars(self).items() if name not in UNLISTED}


UNLISTED = ("commands", "path")
"""Fields of a flight that are arrays, and in no table."""
CLAIMED = ("step_s", "most_step_s", "late", "invalid", "speeding", "trouble")
"""Figures that do not follow from the commands: a replay cannot check them."""
ROBOTS_END = ("crashed", "hung", "flooded")
"""Outcomes of failed robots: the simulation itself could have continued."""
HOVER = np.zeros((1, 4), np.float32)


def fly(simulation: Simulation, robot: Robot) -> Flown:
    """Let a robot fly a mission.

    Errors of the robot are counted, and raise nothing. After an invalid answer the vehicle flies
    the rest of the robot's last plan, and then hovers.

    Args:
        simulation: A new simulation of the mission; it is moved.
        robot: The robot.

    Returns:
        The flight and its scores.
    """
    commands, times = list[Command](), list[float]()
    plan, counts, trouble = HOVER, Counter[str](), ""
    try:
        _call(robot.reset, simulation.about())
        while simulation.outcome is None:
            # the clock begins after the scan, which is not the robot's work
            seen, begin = simulation.observe(), time.perf_counter()
            action = _call(robot.act, seen)
            times.append(time.perf_counter() - begin)
            valid, exceeds = bounded(action, simulation.vehicle)
            counts["speeding"] += exceeds
            counts["invalid"] += valid is None
            # a late or wrong answer must not stop a vehicle in motion: its plan goes on
            plan = (plan[1:] if len(plan) > 1 else HOVER) if valid is None else valid
            commands.append(plan[0])
            simulation.step(plan[0])
    except RobotError as error:
        simulation.outcome, trouble = error.outcome, str(error)
    return scored(simulation, commands, times, counts, trouble)


def _call(method: Any, observation: Observation) -> Any:
    """Call a method of a robot; turn anything that it raises into RobotError."""
    try:
        return method(observation)
    except RobotError:
        raise
    except Exception as error:  # a user's own code may raise anything
        raise RobotError("crashed", f"{type(error).__name__}: {error}"[:200]) from error


def scored(
    simulation: Simulation,
    commands: list[Command],
    times: list[float],
    counts: Counter[str],
    trouble: str,
) -> Flown:
    """Score a flight that has ended.

    Args:
        simulation: The mission after the flight.
        commands: Commands as flown, (4,) each.
        times: Wall-clock time of each decision, seconds.
        counts: How many answers were `invalid`, and how many `speeding`.
        trouble: The robot's error, or "".

    Returns:
        The flight and its scores.
    """
    assert simulation.outcome is not None
    measured, shortest = simulation.measured(), simulation.mission.shortest_m
    time_s, success = simulation.time_s, simulation.outcome == "success"
    best_s = shortest / simulation.vehicle.speed_mps
    mission, radius_m = simulation.mission, simulation.vehicle.radius_m
    end: Any = tuple(simulation.state[POSITION].tolist())
    return Flown(
        outcome=simulation.outcome,
        time_s=time_s,
        shortest_m=shortest,
        blocked=not simulation.world.clearance.motion_is_free(
            mission.start, mission.goal, radius_m
        ),
        # a success ends within `reach_m`, where some way is left
        progress=1.0 if success else progress(simulation.world, mission, radius_m, end),
        **marks(success, time_s, measured["flown_m"], shortest, best_s),
        step_s=float(np.mean(times)) if times else 0.0,
        most_step_s=max(times, default=0.0),
        late=sum(seconds > PERIOD_S for seconds in times),
        invalid=counts["invalid"],
        speeding=counts["speeding"],
        digest=simulation.digest,
        trouble=trouble,
        # the shape (0, 4) if the robot failed before its first command
        commands=np.array(commands, np.float32).reshape(-1, 4),
        path=np.array([states[-1, :3] for states in simulation.states]),
        **measured,
    )


def marks(
    success: bool, time_s: float, flown_m: float, shortest_m: float, best_s: float
) -> dict[str, float]:
    """Return `score`, `spl` and `ratio` of a flight, see `Flown`.

    Args:
        success: Whether it reached its goal.
        time_s: Time flown, seconds.
        flown_m: Length flown, metres.
        shortest_m: Length of the shortest way, metres.
        best_s: Time of the shortest way at full speed, seconds.
    """
    return {
        "score": success * best_s / min(max(time_s, 2 * best_s), 8 * best_s),
        "spl": success * shortest_m / max(shortest_m, flown_m),
        "ratio": flown_m / shortest_m,
    }


def replay_differences(flown: Flown, again: Flown) -> list[str]:
    """Compare a recorded flight with its replay.

    Commands, digest and outcome must be equal; other machines may round sums differently.

    Args:
        flown: The flight as recorded.
        again: The flight as its commands give it.

    Returns:
        A line for each figure that differs.
    """
    differences = []
    for name, value in again.row().items():
        recorded = getattr(flown, name)
        near = isinstance(value, float) and math.isclose(
            value, recorded, rel_tol=1e-9, abs_tol=1e-12
        )
        if name not in CLAIMED and not near and recorded != value:
            differences.append(f"{name} is {recorded} there, {value} flown again")
    if len(flown.commands) != len(again.commands):
        differences.append(
            f"{len(flown.commands)} commands there, {len(again.commands)} flown again"
        )
    return differences
