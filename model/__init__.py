"""What can be inferred: a partial map becomes a completion, a plan, and the tables that say what
both are worth."""
