"""Robots that fly by their observations: one that maps, completes and plans, and a reactive one."""

from scenegen.model.config import PlanConfig

FORGETFUL = "returns"
"""Name of the robot that uses only the last scan."""
SAMPLING = "sampling"
"""Name of the robot that plans by RRT*."""
WITH_NETWORK = {FORGETFUL: "last scan", SAMPLING: "RRT*"}
"""Robots that can fly by a network, too, and the end of their name then."""
COMPLETES_EVERY = 10
"""At how many decisions a network completes the map once; see `MappingRobot`."""
FORESEEING = "foreseeing"
"""Name of the robot that knows where movers are and will be."""
MAPPING = (
    FORGETFUL,
    "optimistic",
    "pessimistic",
    "extrude",
    SAMPLING,
    "forgetting",
    "predicting",
    "truth",
    FORESEEING,
)
"""Robots that map and plan; see `scenegen.model.robots.flights.robot_maker`."""
BRAKING = tuple(name for name in MAPPING if name not in ("truth", FORESEEING))
"""Robots that can brake for what they have not seen; a network's can, too."""
BRAKES = ", brakes"
"""End of the name of a robot that does."""
LEAST_DOUBT = PlanConfig().unseen_risk
"""The least risk of a voxel that nothing has seen."""
REACTIVE = "reactive"
"""Name of the robot without a map."""
NAMES = (*MAPPING, REACTIVE)


def robot_name(robot: str, brakes: float | None) -> str:
    """Name a robot that brakes.

    Args:
        robot: The robot's name.
        brakes: See `MappingRobot`.

    Returns:
        The name, such as "optimistic", "extrude, brakes" or "anywhere, brakes at 0.3".
    """
    return robot if brakes is None else f"{robot}{BRAKES}" + (f" at {brakes:g}" if brakes else "")


def split_robot_name(name: str) -> tuple[str, float | None]:
    """Take apart what `robot_name` made.

    Args:
        name: Name of a robot.

    Returns:
        Its name without brakes; and `brakes`.
    """
    robot, brakes, at = name.partition(BRAKES)
    try:
        return robot, float(at.removeprefix(" at ") or 0) if brakes else None
    except ValueError:  # somebody else's robot
        return name, None
