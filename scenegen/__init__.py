"""What exists: from a seed to a world, its truth, a flight through it, samples, and a dataset on disk."""

__version__ = "0.1.0"

SPLITS = ("train", "val", "test")
"""The parts of a dataset, in order; no world is in two of them."""
