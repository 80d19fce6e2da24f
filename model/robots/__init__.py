"""Robots that fly by their observations: one that maps, completes and plans, and a reactive one."""

FORGETFUL = "returns"
"""Name of the robot that uses only the last scan."""
MAPPING = (FORGETFUL, "optimistic", "pessimistic", "extrude", "truth")
"""Robots that map and plan; see `scenegen.model.robots.flights.robot_maker`."""
REACTIVE = "reactive"
"""Name of the robot without a map."""
NAMES = (*MAPPING, REACTIVE)
