"""A robot flies a mission: it sees, decides, and moves, ten times a second; and how well it did."""

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
from scenegen.fly.motion import Command
from scenegen.fly.simulation import Observation, Outcome, Simulation, bounded


class Robot(Protocol):
    """What decides where to fly. One of your own is a class with these two, made without
    arguments."""

    def reset(self, about: Observation) -> None:
        """A flight begins; see `Simulation.about`."""
        ...

    def act(self, observation: Observation) -> Any:
        """Velocity in the world, m/s, and rate of yaw, rad/s, (4,); or those of up to ten periods
        to come, (n, 4), of which the later ones are flown where the next answers are none.

        `observation` is that of `Simulation.observe`.
        """
        ...


class RobotError(ScenegenError):
    """A robot ended, or had to be ended; `outcome` says why."""

    def __init__(self, outcome: Outcome, text: str):
        super().__init__(text)
        self.outcome = outcome


@dataclass(frozen=True, kw_only=True)
class Flown:
    """One flight of a robot. Lengths and times are those until it ended."""

    outcome: Outcome
    score: float
    """BARN's (Xiao et al. 2022): 0, or T* / clip(T, 2 T*, 8 T*) for a success, where T* is the
    shortest way at full speed."""
    spl: float
    """Success weighted by path length (Anderson et al. 2018)."""
    time_s: float
    """Time flown, seconds."""
    ratio: float
    """Length flown over that of the shortest way."""
    shortest_m: float = number(above=0)
    """Length of the shortest way, metres."""
    flown_m: float
    """Length flown, metres."""
    speed_mps: float
    """Mean speed, metres a second."""
    min_clearance_m: float
    """Least distance of the vehicle's centre from a solid, at most 1 m, metres."""
    mean_clearance_m: float
    """Its mean over time, metres."""
    jerk_mps3: float
    """Root mean square of the jerk, metres a second cubed."""
    step_s: float
    """Mean time for a decision by the clock, seconds."""
    most_step_s: float
    """The longest, seconds."""
    late: int
    """Decisions that took longer than a period."""
    invalid: int
    """Answers that were no action: NaN, or of another shape."""
    speeding: int
    """Answers beyond the vehicle's bounds, which were cut."""
    digest: str
    """SHA-256 of all that was seen and flown."""
    trouble: str = ""
    """What the robot died of."""
    commands: Command = field(repr=False)
    """(periods, 4): what was flown, m/s and rad/s."""
    path: Floats = field(repr=False)
    """(n, 3): the way, world metres, a point a period."""

    def row(self) -> dict[str, Any]:
        """All but the last two, by name."""
        return {name: value for name, value in vars(self).items() if name not in UNSAID}


UNSAID = ("commands", "path")
CLAIMED = ("step_s", "most_step_s", "late", "invalid", "speeding", "trouble")
"""Parts of a flight that its commands do not tell: only who let the robot fly knows them."""
ROBOTS_END = ("crashed", "hung", "flooded")
"""Outcomes that are the robot's doing: the vehicle itself could have flown on."""
HOVER = np.zeros((1, 4), np.float32)


def fly(simulation: Simulation, robot: Robot) -> Flown:
    """Let `robot` fly the mission. Whatever it does is counted, and raises nothing: without an
    action of its own, the vehicle flies the rest of the plan that it gave last, and then hovers."""
    commands, times = list[Command](), list[float]()
    plan, counts, trouble = HOVER, Counter[str](), ""
    try:
        _asked(robot.reset, simulation.about())
        while simulation.outcome is None:
            seen, begin = simulation.observe(), time.perf_counter()
            action = _asked(robot.act, seen)
            times.append(time.perf_counter() - begin)
            given, exceeds = bounded(action, simulation.vehicle)
            counts["speeding"] += exceeds
            counts["invalid"] += given is None
            plan = (plan[1:] if len(plan) > 1 else HOVER) if given is None else given
            commands.append(plan[0])
            simulation.step(plan[0])
    except RobotError as error:
        simulation.outcome, trouble = error.outcome, str(error)
    return scored(simulation, commands, times, counts, trouble)


def _asked(method: Any, observation: Observation) -> Any:
    """What a robot says; whatever it raises is a RobotError."""
    try:
        return method(observation)
    except RobotError:
        raise
    except Exception as error:
        raise RobotError("crashed", f"{type(error).__name__}: {error}"[:200]) from error


def scored(
    simulation: Simulation,
    commands: list[Command],
    times: list[float],
    counts: Counter[str],
    trouble: str,
) -> Flown:
    """What came of a flight; for the arguments see `Flown`."""
    assert simulation.outcome is not None
    measured, shortest = simulation.measured(), simulation.mission.shortest_m
    time_s, success = simulation.time_s, simulation.outcome == "success"
    best_s = shortest / simulation.vehicle.speed_mps
    return Flown(
        outcome=simulation.outcome,
        time_s=time_s,
        shortest_m=shortest,
        **marks(success, time_s, measured["flown_m"], shortest, best_s),
        step_s=float(np.mean(times)) if times else 0.0,
        most_step_s=max(times, default=0.0),
        late=sum(seconds > PERIOD_S for seconds in times),
        invalid=counts["invalid"],
        speeding=counts["speeding"],
        digest=simulation.digest,
        trouble=trouble,
        commands=np.array(commands, np.float32).reshape(-1, 4),
        path=np.array([states[-1, :3] for states in simulation.states]),
        **measured,
    )


def marks(
    success: bool, time_s: float, flown_m: float, shortest_m: float, best_s: float
) -> dict[str, float]:
    """`score`, `spl` and `ratio` of a flight, see `Flown`; `best_s` is what the shortest way takes
    at full speed."""
    return {
        "score": success * best_s / min(max(time_s, 2 * best_s), 8 * best_s),
        "spl": success * shortest_m / max(shortest_m, flown_m),
        "ratio": flown_m / shortest_m,
    }


def unlike(flown: Flown, again: Flown) -> list[str]:
    """In which figures a recorded flight is not what its commands give `again`, as texts. Commands,
    bits and outcome must be equal; sums may be rounded otherwise by another machine."""
    found = []
    for name, value in again.row().items():
        there = getattr(flown, name)
        near = isinstance(value, float) and math.isclose(value, there, rel_tol=1e-9, abs_tol=1e-12)
        if name not in CLAIMED and not near and there != value:
            found.append(f"{name} is {there} there, {value} flown again")
    if len(flown.commands) != len(again.commands):
        found.append(f"{len(flown.commands)} commands there, {len(again.commands)} flown again")
    return found
