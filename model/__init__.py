"""From a partial map to a completion and a plan, and the tables that measure both."""
