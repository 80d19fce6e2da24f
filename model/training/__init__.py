"""Networks learn: samples in a seeded order, the loop, its validation, and the folder that a run
leaves."""
