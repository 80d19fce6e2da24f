"""What can be inferred from a partial map. The completion network, its training and the bench will live here; so far
the package is empty, and nothing imports it."""
