"""What exists: from a seed to a world, its truth, a flight through it, samples, and a dataset on disk.

``scenegen.load("data/pillar", split="train")`` reads one.
"""

from __future__ import annotations

TYPE_CHECKING = False  # as typing has it, which takes time to import: a command answers stops from here on
if TYPE_CHECKING:
    from pathlib import Path

    from scenegen.dataset.read import Split

__version__ = "0.1.0"

GENERATOR = 2
"""Raised whenever the same parameters and seed would give other bits, whatever the kind of worlds. 1 was bound to its
processor: numpy and the mathematical library choose sines, arctangents and products by what it offers."""

SPLITS = ("train", "val", "test")
"""The parts of a dataset, in order; no world is in two of them."""


def load(dataset: str | Path, split: str = "train") -> Split:
    """The samples of a split, read when asked for: a sequence of `scenegen.sample.Sample`, without a copy in memory.

    `dataset` is a folder, or ``hf://user/name[@revision]``, which is downloaded once and checked. The sequence may be
    handed to any number of processes, forked or spawned, each of which opens the files for itself; `describe()` gives
    names, types, shapes, units and meanings. Raises DatasetError.
    """
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset

    return Dataset(locate(dataset)).split(split)
