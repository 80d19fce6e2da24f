"""Robots that fly by their observations: one that maps, completes and plans, and a reactive one."""

FORGETFUL = "returns"
"""Name of the robot that uses only the last scan."""
FORESEEING = "foreseeing"
"""Name of the robot that knows where movers are and will be."""
MAPPING = (
    FORGETFUL,
    "optimistic",
    "pessimistic",
    "extrude",
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
REACTIVE = "reactive"
"""Name of the robot without a map."""
NAMES = (*MAPPING, REACTIVE)
