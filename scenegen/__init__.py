"""What exists: from a seed to a world, its truth, a flight through it, samples, and a dataset on
disk.

``scenegen.load("data/pillar", split="train")`` reads one; ``scenegen.stream("pillar")`` has its
samples without a disk.
"""

from __future__ import annotations

TYPE_CHECKING = (
    False  # as typing has it, which takes time to import: a command answers stops from here on
)
if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from scenegen.dataset.read import Split
    from scenegen.streams.stream import Stream

__version__ = "0.1.0"

GENERATOR = 2
"""Raised whenever the same parameters and seed would give other bits, whatever the kind of worlds.
1 was bound to its processor: numpy and the mathematical library choose sines, arctangents and
products by what it offers."""

SPLITS = ("train", "val", "test")
"""The parts of a dataset, in order; no world is in two of them."""


def load(dataset: str | Path, split: str = "train") -> Split:
    """The samples of a split, read when asked for: a sequence of `scenegen.sample.Sample`, without
    a copy in memory.

    `dataset` is a folder, or ``hf://user/name[@revision]``, which is downloaded once and checked.
    The sequence may be handed to any number of processes, forked or spawned, each of which opens
    the files for itself; `describe()` gives names, types, shapes, units and meanings. Raises
    DatasetError.
    """
    from scenegen.dataset.locate import locate
    from scenegen.dataset.read import Dataset

    return Dataset(locate(dataset)).split(split)


def stream(
    worlds: Any,
    *,
    seed: int = 0,
    split: str = "train",
    samples: int = 10**9,
    workers: int = 0,
    cache: str | Path | None = None,
    engine: str = "mujoco",
) -> Stream:
    """Samples by number, drawn when asked for: the first n are those that `generate` gives with
    this seed and split.

    `worlds` is a kind's name, a recipe or its TOML file, an MJCF file or a folder of them; or
    several, as a list, or as a mapping to weights, in proportion to which samples come, by a fixed
    rule (docs/stream.md). Worlds of one split are in no other, because the split is part of what
    each draw is seeded with. `samples` is the stream's `len`. `workers` processes draw ahead of
    need; 0 draws in the process that asks. `cache` is a folder that keeps what was drawn. `engine`
    names what casts the rays. No torch is needed. Raises RecipeError, SceneError and DatasetError,
    and when a sample is asked for GenerationError, IndexError and TypeError; all in one line.
    """
    from scenegen.streams.stream import stream_of

    return stream_of(
        worlds, seed=seed, split=split, samples=samples, workers=workers, cache=cache, engine=engine
    )
