"""Robots that fly: those that map, complete and plan, and one without a map."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from scenegen.errors import ScenegenError

if TYPE_CHECKING:  # the command line asks for the names alone
    from scenegen.fly.course import Course
    from scenegen.fly.loop import Flown

MAPPING = {
    "returns": "what the last scan says, unknown voxels free",
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
    `weights` complete; or one's own, which runs in a process of its own."""
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
        return lambda course: MappingRobot(network)
    known: dict[str, Callable[[Course], Any]] = {
        "returns": lambda course: MappingRobot(Returns(), memory=False),
        "optimistic": lambda course: MappingRobot(Returns()),
        "pessimistic": lambda course: MappingRobot(Conservative()),
        "extrude": lambda course: MappingRobot(Extrude()),
        "truth": lambda course: TruthRobot(course.drawn),
        REACTIVE: lambda course: ReactiveRobot(),
    }
    return known.get(name) or (lambda course: own_robot(name))


def fly_course(
    course: "Course", *, robot: str, weights: str | None
) -> "tuple[Course, Sequence[Flown]]":
    """All flights of a course, one after the other, by the same robot."""
    from scenegen.fly.loop import fly as fly_mission

    made = robot_maker(robot, weights)(course)
    try:
        flown = [fly_mission(course.simulation(n), made) for n in range(course.flights)]
    finally:
        getattr(made, "close", lambda: None)()
    if all(one.outcome == "crashed" and not one.time_s for one in flown):
        raise ScenegenError(f"--robot {robot}: never begins: {flown[0].trouble}")
    return course, flown


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
