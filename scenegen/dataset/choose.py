"""Which samples of a dataset are taken: by split, world, number, and by what is measured of one
sample."""

import io
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from lidarsim.grid import Field, Floats, Ints, Mask
from lidarsim.sensors.table import MOST_HEADER_BYTES, read_npy
from scenegen import SPLITS
from scenegen.dataset.read import Dataset, Split
from scenegen.dataset.trust import Entry
from scenegen.errors import DatasetError, ScenegenError, short
from scenegen.files import read_bounded
from scenegen.limits import MOST_SAMPLES
from scenegen.run import chunked
from scenegen.run.workers import run
from scenegen.sample import Sample
from scenegen.truth.difficulty import Difficulty, difficulty


def _ranges(sample: Sample) -> Field:
    """The ranges of all scans of a sample, (scans, *rays), metres."""
    earlier = sample.earlier_ranges
    return np.array([sample.ranges, *(() if earlier is None else earlier)])


def _range_m(sample: Sample) -> float:
    ranges = _ranges(sample)
    hit = ranges[np.isfinite(ranges)]
    return float(hit.mean()) if len(hit) else float("nan")


@lru_cache(maxsize=1)  # its measures are asked for one after the other
def _difficulties(sample: Sample) -> Difficulty:
    assert sample.grid is not None
    return difficulty(sample.occupancy, sample.tudf, sample.grid.voxel_m)


def _difficulty(number: int, sample: Sample) -> float:
    return float(_difficulties(sample)[number])


MEASURES: Mapping[str, Callable[[Sample], float]] = {
    "occupied": lambda sample: float(sample.occupancy.mean()),
    "observed": lambda sample: float(sample.observed.mean()),
    "free": lambda sample: float(sample.free.mean()),
    "unknown": lambda sample: float(1 - (sample.observed | sample.free).mean()),
    "returned": lambda sample: float(np.isfinite(_ranges(sample)).mean()),
    "range_m": _range_m,
    "tudf_m": lambda sample: float(sample.tudf.mean()),
    **{name: partial(_difficulty, n) for n, name in enumerate(Difficulty._fields)},
}
"""What `inspect` measures of a sample, and `take --where` asks by; nothing of it is stored in one.
Shares of all voxels; of all rays, those that returned; the mean range of these, metres, NaN for
none; the mean distance of the map's voxels, metres; and how hard the map is."""
COLUMNS = tuple(MEASURES)
ROW = np.dtype([(name, "<f8") for name in MEASURES])
"""A sample in the file of measures."""

NUMBERS = ("sample", "world", "viewpoint")
"""What can be asked of a sample without reading it: its number in the split, and who it is."""
OF_WORLD = "world_"
"""Before the name of a measure: its mean over all maps of a sample's world."""
SIGNS = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
    "=": operator.eq,
}
AT_ONCE = 16
"""Shards that a worker is given before it is seen whether enough was found."""


def measures_file(dataset: Dataset) -> Path:
    """Where `scenegen inspect --keep` puts the measures of all samples of a complete dataset:
    beside its shards, by its digest, so that those of another dataset are never taken for its
    own."""
    return dataset.folder / f"figures-{str(dataset.manifest.digest)[:16]}.npy"


def encode_measures(table: Floats) -> bytes:
    """The content of that file, from the `MEASURES` (samples, measures) of all splits in order."""
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(table, "<f8").view(ROW)[:, 0])
    return file.getvalue()


def kept_measures(dataset: Dataset) -> dict[str, Floats]:
    """What that file holds, (samples, measures) by split; {} where there is none, or it is not as
    this version writes it."""
    counts = [len(dataset.split(name)) for name in SPLITS]
    try:
        most = sum(counts) * ROW.itemsize + MOST_HEADER_BYTES
        table = read_npy(read_bounded(measures_file(dataset), most))
    except (OSError, ValueError, ScenegenError):
        return {}
    if table.dtype != ROW or table.shape != (sum(counts),):
        return {}
    table = table.view("<f8").reshape(-1, len(COLUMNS))
    return dict(zip(SPLITS, np.split(table, np.cumsum(counts)[:-1]), strict=True))


@dataclass(frozen=True)
class Condition:
    """A bound of one measure. A measure that a sample does not have fulfils none."""

    name: str
    sign: str
    value: float

    @classmethod
    def of(cls, text: str) -> "Condition":
        """The condition that is written like ``occupied>=0.05``. Raises ValueError."""
        number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
        match = re.fullmatch(rf"\s*(\w+)\s*(<=|>=|<|>|=)\s*({number})\s*", text, re.ASCII)
        known = (*NUMBERS, *MEASURES, *(OF_WORLD + name for name in MEASURES))
        if match and match[1] in known:
            return cls(match[1], match[2], float(match[3]))
        raise ValueError(
            f"{short(text)}: expected a name, a sign and a number, such as occupied>=0.05; names "
            f"are {', '.join(known)}, signs {' '.join(SIGNS)}"
        )

    def __str__(self) -> str:
        # to the last digit: it is what tells a dataset that was taken from another
        return f"{self.name}{self.sign}{self.value!r}".removesuffix(".0")

    def holds(self, values: Any) -> Any:
        """Whether a number, or each of an array, fulfils it."""
        return SIGNS[self.sign](values, self.value)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Samples to take: all that fulfil every condition, or the first of them."""

    splits: tuple[str, ...] = SPLITS
    most: int | None = None
    """The most samples of each split; None for no bound."""
    kinds: tuple[str, ...] = ()
    """Kinds of worlds, as "maze", or "maze-hard" for another difficulty; empty for all."""
    worlds: tuple[tuple[int, int], ...] = ()
    """Numbers of worlds, (first, one past last) each; empty for all."""
    where: tuple[Condition, ...] = ()

    def __str__(self) -> str:
        """As the command's options say it; what a manifest tells of it."""
        words = [f"--split {split}" for split in self.splits if self.splits != SPLITS]
        words += [] if self.most is None else [f"--n {self.most}"]
        words += [f"--kind {kind}" for kind in self.kinds]
        words += [f"--worlds {','.join(f'{a}:{b}' for a, b in self.worlds)}"] if self.worlds else []
        return " ".join([*words, *(f"--where {condition}" for condition in self.where)])


@dataclass(frozen=True, eq=False, kw_only=True)
class Chosen:
    """The samples that are taken of one shard."""

    dataset: Dataset
    entry: Entry
    rows: Ints
    """The rows of the shard's samples that are taken, in order."""
    places: Ints
    """The positions of these samples in the split of the dataset that they were made for."""

    def only(self, kept: Any) -> "Chosen":
        """The same with those samples alone that `kept` says, a mask or a slice."""
        return replace(self, rows=self.rows[kept], places=self.places[kept])


def choose(dataset: Dataset, choice: Choice, *, workers: int = 1) -> Iterator[Chosen]:
    """The samples of `dataset` that are taken, shard by shard in its order, and none of a shard
    without any.

    Samples are read only where something measured is asked for that is not kept beside them, by
    `workers` processes. Raises DatasetError, also where measures of whole worlds are not kept.
    """
    conditions = tuple(one for one in choice.where if one.name not in NUMBERS)
    kept = kept_measures(dataset) if conditions else {}
    of_worlds = [one.name for one in conditions if one.name not in MEASURES]
    if of_worlds and not kept:
        raise DatasetError(
            f"{dataset.folder}: {of_worlds[0]} is a mean over all maps of a world; measure these "
            f"first: scenegen inspect {quote(str(dataset.folder))} --keep"
        )
    for name in SPLITS:
        if name not in choice.splits:
            continue
        split = dataset.split(name)
        measures = {one.name: measure_of(split, kept[name], one.name) for one in conditions if kept}
        left = MOST_SAMPLES if choice.most is None else choice.most
        for chosen in _of_split(split, choice, conditions, measures, workers):
            chosen = chosen.only(slice(left))
            left -= len(chosen.rows)
            if len(chosen.rows):
                yield chosen
            if not left:
                break


def _of_split(
    split: Split,
    choice: Choice,
    conditions: tuple[Condition, ...],
    measures: Mapping[str, Floats],
    workers: int,
) -> Iterator[Chosen]:
    """What is taken of each shard of a split, however much that is. `conditions` are those on what
    is measured: they are held against the `measures` of all samples by name, (samples,) each, or,
    if these are not kept, against samples that are read."""
    home = split.dataset.manifest.home
    numbers = [
        number
        for number, entry in enumerate(split.shards)
        if not choice.kinds or home(entry).graded in choice.kinds
    ]
    if measures or not conditions:
        yield from (_of_shard(split, number, choice, measures) for number in numbers)
        return
    # not all at once: whoever takes the first of them needs no more measured
    for part in chunked(numbers, workers * AT_ONCE):
        shards = {number: _of_shard(split, number, choice, {}) for number in part}
        tasks = [(number, shard.rows) for number, shard in shards.items()]
        fulfil = dict(run(partial(_fulfil, split, conditions), tasks, workers))
        yield from (shard.only(fulfil[number]) for number, shard in shards.items())


def measure_of(split: Split, table: Floats, name: str) -> Floats:
    """A measure of all samples of a split, from the `MEASURES` (samples, measures) of these; NaN
    for none. Raises DatasetError."""
    own = table[:, COLUMNS.index(name.removeprefix(OF_WORLD))]
    if name in MEASURES:
        return own
    worlds, here = split.numbers[0], ~np.isnan(own)
    with np.errstate(invalid="ignore"):  # a world may have none
        means = np.bincount(worlds, np.where(here, own, 0)) / np.bincount(worlds, here)
    return means[worlds]


def _of_shard(split: Split, number: int, choice: Choice, measures: Mapping[str, Floats]) -> Chosen:
    """What is taken of a shard by its samples' numbers, and by the `measures` of all samples of the
    split, where these are kept."""
    entry, places = split.shards[number], split.places(number)
    samples = split.first(number) + np.arange(len(places))
    values = dict(zip(NUMBERS, (samples, *split.numbers_in(number)), strict=True))
    values |= {name: column[samples] for name, column in measures.items()}
    kept = np.ones(len(places), bool)
    if choice.worlds:
        world = values["world"]
        ranges = [(world >= first) & (world < stop) for first, stop in choice.worlds]
        kept &= np.any(ranges, axis=0)
    for condition in choice.where:
        if condition.name in values:
            kept &= condition.holds(values[condition.name])
    rows = np.flatnonzero(kept)
    return Chosen(dataset=split.dataset, entry=entry, rows=rows, places=places[kept])


def _fulfil(
    split: Split, conditions: tuple[Condition, ...], task: tuple[int, Ints]
) -> tuple[int, Mask]:
    """Which of the rows of a shard fulfil the conditions on what is measured; with its number."""
    number, rows = task
    samples = (split[split.first(number) + row] for row in rows.tolist())
    return number, np.array(
        [all(one.holds(MEASURES[one.name](sample)) for one in conditions) for sample in samples],
        bool,
    )
