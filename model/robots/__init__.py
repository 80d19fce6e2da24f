"""Robots that fly: those that map, complete and plan, and one without a map."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from scenegen.errors import ScenegenError

if TYPE_CHECKING:  # the command line asks for the names alone
    from scenegen.fly.course import Course
    from scenegen.fly.loop import Flown
    from scenegen.truth.difficulty import Difficulty

FORGETFUL = "returns"
"""The one that remembers nothing."""
MAPPING = {
    FORGETFUL: "what the last scan says, unknown voxels free",
    "optimistic": "what all scans say, unknown voxels free",
    "pessimistic": "what all scans say, unknown voxels occupied",
    "extrude": "all scans, returns extended up and down",
    "truth": "the truth, which nobody else gets",
}
"""Robots that map and plan, by what they take for occupied."""
REACTIVE = "reactive"
"""The one without a map."""
NAMES = (*MAPPING, REACTIVE)
RATIOS = ("score", "spl", "ratio", "speed_mps", "mean_clearance_m", "jerk_mps3", "step_s")
"""Figures of which the mean over flights is told."""
COUNTS = ("late", "invalid", "speeding")
"""Those of which the sum is."""


def robot_maker(name: str, weights: str | None) -> "Callable[[Course], Any]":
    """What makes the robot for a course: one of `NAMES`; one that maps and has the network called
    `weights` complete, from the last scan alone where its name is "returns"; or one's own, which
    runs in a process of its own."""
    from scenegen.fly.pipe import own_robot
    from scenegen.model.completion.unlearned import Conservative, Extrude, Returns
    from scenegen.model.robots.mapping import MappingRobot, TruthRobot
    from scenegen.model.robots.reactive import ReactiveRobot

    if weights is not None:
        from scenegen.model.completion.completer import opened_once

        network = opened_once(weights, "cpu", 1)
        if set(network.inputs) - {"observed", "free"}:
            raise ScenegenError(
                f"{weights}: takes {', '.join(network.inputs)}; robots give "
                "observed and free voxels alone"
            )
        memory = name != FORGETFUL
        return lambda course: MappingRobot(network, memory=memory, doubts=True)
    known: dict[str, Callable[[Course], Any]] = {
        FORGETFUL: lambda course: MappingRobot(Returns(), memory=False),
        "optimistic": lambda course: MappingRobot(Returns()),
        "pessimistic": lambda course: MappingRobot(Conservative(), frontier=True),
        "extrude": lambda course: MappingRobot(Extrude(), doubts=True),
        "truth": lambda course: TruthRobot(course.simulated),
        REACTIVE: lambda course: ReactiveRobot(),
    }
    return known.get(name) or (lambda course: own_robot(name))


def real_course(course: "Course", hidden: int | None) -> "Course":
    """The course to fly: of a hidden track, the one that the number `hidden` draws."""
    from scenegen.fly.suite import hidden_course

    return course if hidden is None else hidden_course(course, hidden)


def fly_course(
    course: "Course", *, robot: str, weights: str | None, hidden: int | None = None
) -> "tuple[Course, Sequence[Flown]]":
    """All flights of a course, one after the other, by the same robot; with the course, which then
    has its world's hash. For `hidden` see `real_course`."""
    from scenegen.fly.loop import fly as fly_mission

    real = real_course(course, hidden)
    made = robot_maker(robot, weights)(real)
    try:
        flown = [fly_mission(real.simulation(n), made) for n in range(real.flights)]
    finally:
        getattr(made, "close", lambda: None)()
    return replace(course, document=real.sha256), flown


def grade_course(course: "Course", *, hidden: int | None) -> "tuple[Course, list[Difficulty]]":
    """How hard the missions of a course are."""
    return course, real_course(course, hidden).graded()


def check_begins(robot: str, course: "Course") -> None:
    """Raise ScenegenError where a robot of one's own ends before it is ready for its first flight,
    so that a word mistyped is not flown 1500 times."""
    from scenegen.fly.loop import RobotError
    from scenegen.fly.pipe import own_robot

    made = own_robot(robot)
    try:
        made.reset(course.simulation(0).about())
    except RobotError as error:
        if error.outcome == "crashed":
            raise ScenegenError(f"--robot {robot}: never begins: {error}") from None
    finally:
        made.close()


def summary(name: str, flown: "Sequence[Flown]") -> dict[str, Any]:
    """What is told of flights, together."""
    import numpy as np

    ends = Counter(one.outcome for one in flown)
    row: dict[str, Any] = {"robot": name, "flights": len(flown)}
    row |= {end: f"{100 * count / len(flown):.0f} %" for end, count in ends.most_common()}
    row |= {
        part: round(float(np.mean([getattr(one, part) for one in flown])), 4) for part in RATIOS
    }
    row["min_clearance_m"] = round(min(one.min_clearance_m for one in flown), 4)
    row["most_step_s"] = round(max(one.most_step_s for one in flown), 4)
    return row | {part: sum(getattr(one, part) for one in flown) for part in COUNTS}
