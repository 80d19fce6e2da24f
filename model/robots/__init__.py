"""Robots that fly: those that map, complete and plan, and one without a map."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from scenegen.errors import ScenegenError

if TYPE_CHECKING:  # the command line asks for the names alone
    from scenegen.fly.course import Course

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
