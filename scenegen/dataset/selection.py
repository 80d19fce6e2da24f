"""Which samples of a dataset are taken: by split, world, number, and by what is measured of one
sample."""

import hashlib
import io
import json
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from shlex import quote
from typing import Any

import msgspec
import numpy as np

from lidarsim.grid import Field, Floats, Ints
from lidarsim.sensors.table import MOST_HEADER_BYTES, read_npy
from scenegen import SPLITS
from scenegen.base.errors import DatasetError, ScenegenError, short
from scenegen.base.executors import chunked
from scenegen.base.files import read_bounded
from scenegen.base.workers import run
from scenegen.dataset.collection import SelectedDataset, SelectionFile, name_from
from scenegen.dataset.read import AnyDataset, Dataset, Piece, Split
from scenegen.draw.sample import Sample
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
AT_ONCE = 1000
"""Samples that a worker is given before it is seen whether enough were found."""
DIGEST_BYTES = 32
MEASURED_AGAIN = 5
"""So many samples are measured again before measures that are kept are believed."""


def measures_file(dataset: Dataset) -> Path:
    """Where `scenegen inspect --keep` puts the measures of all samples of a complete dataset:
    beside its shards, by its digest, so that those of another dataset are never taken for its
    own."""
    return dataset.folder / f"figures-{dataset.digest[:16]}.npy"


def encode_measures(table: Floats) -> bytes:
    """The content of that file: the `MEASURES` (samples, measures) of all splits in order, and
    behind them their SHA-256."""
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(table, "<f8").view(ROW)[:, 0])
    return file.getvalue() + hashlib.sha256(file.getvalue()).digest()


def kept_measures(dataset: AnyDataset) -> dict[str, Floats]:
    """The measures that are kept beside a dataset, (samples, measures) by split; {} where there are
    none, or the file is damaged or not as this version writes it.

    Of a collection, they are those of its datasets, where all have them.

    Raises:
        DatasetError: A few samples were measured again, and are not as the file says.
    """
    tables = {one.folder: _kept_of_one(one) for one in dataset.datasets}
    if not all(tables.values()):
        return {}
    of_dataset = {}
    for name in SPLITS:
        split = dataset.split(name)
        columns = [tables[piece.dataset.folder][name][own_numbers(piece)] for piece in split.pieces]
        of_dataset[name] = np.concatenate([np.empty((0, len(COLUMNS))), *columns])
    return of_dataset


def own_numbers(piece: Piece) -> Ints:
    """The numbers, (N,), of a piece's samples in the split of their dataset."""
    split = piece.dataset.split(piece.entry.split)
    first = split.first([one.entry for one in split.pieces].index(piece.entry))
    return first + (np.arange(piece.entry.samples) if piece.rows is None else piece.rows)


def _kept_of_one(dataset: Dataset) -> dict[str, Floats]:
    """See `kept_measures`."""
    counts = [len(dataset.split(name)) for name in SPLITS]
    path = measures_file(dataset)
    try:
        most = sum(counts) * ROW.itemsize + MOST_HEADER_BYTES + DIGEST_BYTES
        content = read_bounded(path, most)
        body, digest = content[:-DIGEST_BYTES], content[-DIGEST_BYTES:]
        if hashlib.sha256(body).digest() != digest:
            return {}
        table = read_npy(body)
    except (OSError, ValueError, ScenegenError):
        return {}
    if table.dtype != ROW or table.shape != (sum(counts),):
        return {}
    table = table.view("<f8").reshape(-1, len(COLUMNS))
    by_split = dict(zip(SPLITS, np.split(table, np.cumsum(counts)[:-1]), strict=True))
    name = max(by_split, key=lambda name: len(by_split[name]))
    samples = len(by_split[name])
    for index in np.linspace(0, samples - 1, min(MEASURED_AGAIN, samples)).astype(int).tolist():
        sample = dataset.split(name)[index]
        again = [measure(sample) for measure in MEASURES.values()]
        if not np.array_equal(by_split[name][index], again, equal_nan=True):
            raise DatasetError(
                f"{path}: what it says of {name} sample {index} is not what is measured of it; "
                f"measure again: scenegen inspect {quote(str(dataset.folder))} --keep"
            )
    return by_split


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
        """As the command's options say it; what a selection tells of it."""
        words = [f"--split {split}" for split in self.splits if self.splits != SPLITS]
        words += [] if self.most is None else [f"--n {self.most}"]
        words += [f"--kind {kind}" for kind in self.kinds]
        words += [f"--worlds {','.join(f'{a}:{b}' for a, b in self.worlds)}"] if self.worlds else []
        return " ".join([*words, *(f"--where {condition}" for condition in self.where)])


def choose(dataset: AnyDataset, choice: Choice, *, workers: int = 1) -> dict[str, Ints]:
    """The samples of `dataset` that are taken: their numbers in each split, rising.

    Samples are read only where something measured is asked for that is not kept beside them, by
    `workers` processes. Raises DatasetError, also where measures of whole worlds are not kept.
    """
    conditions = tuple(one for one in choice.where if one.name not in NUMBERS)
    kept = kept_measures(dataset) if conditions else {}
    of_worlds = [one.name for one in conditions if one.name not in MEASURES]
    if of_worlds and not kept:
        lacking = [one for one in dataset.datasets if not _kept_of_one(one)]
        commands = [f"scenegen inspect {quote(str(one.folder))} --keep" for one in lacking]
        raise DatasetError(
            f"{dataset.name}: {of_worlds[0]} is a mean over all maps of a world; measure these "
            f"first: {'; '.join(commands)}"
        )
    numbers = {}
    for name in (name for name in SPLITS if name in choice.splits):
        split = dataset.split(name)
        candidates = _by_number(split, choice)
        if kept:
            for condition in conditions:
                values = measure_of(split, kept[name], condition.name)
                candidates = candidates[condition.holds(values[candidates])]
        elif conditions:
            candidates = _by_measuring(split, conditions, candidates, choice.most, workers)
        numbers[name] = candidates[: choice.most]
    return numbers


def _by_number(split: Split, choice: Choice) -> Ints:
    """The samples of a split that fulfil what can be asked without reading them."""
    world, viewpoint = split.numbers
    values = {"sample": np.arange(len(split)), "world": world, "viewpoint": viewpoint}
    kept = np.ones(len(split), bool)
    if choice.kinds:
        kept[:] = False
        for kind, of_kind in split.by_kind().items():
            kept[of_kind] = kind in choice.kinds
    if choice.worlds:
        ranges = [(world >= first) & (world < stop) for first, stop in choice.worlds]
        kept &= np.any(ranges, axis=0)
    for condition in choice.where:
        if condition.name in values:
            kept &= condition.holds(values[condition.name])
    return np.flatnonzero(kept)


def _by_measuring(
    split: Split,
    conditions: tuple[Condition, ...],
    candidates: Ints,
    most: int | None,
    workers: int,
) -> Ints:
    """Those of the `candidates` whose measures fulfil the `conditions`; of more than `most`, some
    may be left out."""
    fulfilling = list[int]()
    # not all at once: whoever takes the first of them needs no more measured
    for chunk in chunked(candidates.tolist(), workers * AT_ONCE):
        if most is not None and len(fulfilling) >= most:
            break
        for number, fulfils in run(partial(_fulfils, split, conditions), chunk, workers):
            fulfilling += [number] if fulfils else []
    return np.array(sorted(fulfilling), np.int64)


def _fulfils(split: Split, conditions: tuple[Condition, ...], number: int) -> tuple[int, bool]:
    """The number of a sample, and whether it fulfils the conditions on what is measured."""
    sample = split[number]
    return number, all(one.holds(MEASURES[one.name](sample)) for one in conditions)


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


def encode_selection(
    dataset: AnyDataset, numbers: Mapping[str, Ints], choice: Choice, folder: Path
) -> bytes:
    """The content of a selection's file in `folder`: the samples of `dataset` with these `numbers`,
    which `choice` describes."""
    chosen: dict[Path, dict[str, list[int]]] = {one.folder: {} for one in dataset.datasets}
    for name, of_split in numbers.items():
        for piece in (split := dataset.split(name)).taken(of_split.tolist()):
            own = own_numbers(piece).tolist()
            chosen[piece.dataset.folder].setdefault(split.name, []).extend(own)
    datasets = [
        SelectedDataset(
            path=name_from(folder, one.folder), digest=one.digest, samples=chosen[one.folder]
        )
        for one in dataset.datasets
        if chosen[one.folder]
    ]
    document = msgspec.to_builtins(SelectionFile(chosen_by=str(choice), datasets=datasets))
    return (json.dumps(document) + "\n").encode()
