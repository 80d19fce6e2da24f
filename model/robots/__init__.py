"""Robots that fly by what they see: a mapping one, by completions and plans, and a reactive one."""

FORGETFUL = "returns"
"""The one that remembers nothing."""
MAPPING = (FORGETFUL, "optimistic", "pessimistic", "extrude", "truth")
"""Robots that map and plan; see `scenegen.model.robots.flights.robot_maker`."""
REACTIVE = "reactive"
"""The one without a map."""
NAMES = (*MAPPING, REACTIVE)
