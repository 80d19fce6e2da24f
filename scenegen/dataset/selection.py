"""Select samples of a dataset by split, world, number, and measures of the sample."""

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
from lidarsim.parameters import short_repr
from lidarsim.sensors.table import MAX_NPY_HEADER_BYTES, read_npy
from scenegen import SPLITS
from scenegen.base.errors import DatasetError, ScenegenError
from scenegen.base.executors import chunked
from scenegen.base.reading import read_bounded
from scenegen.base.workers import run
from scenegen.dataset.collection import SelectedDataset, SelectionFile, name_from
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.read import AnyDataset, Dataset, Piece, Split
from scenegen.draw.sample import Sample
from scenegen.truth.difficulty import Difficulty, difficulty


def _ranges(sample: Sample) -> Field:
    """Ranges of all scans of a sample, (scans, *rays), metres."""
    earlier = sample.earlier_ranges
    return np.array([sample.ranges, *(() if earlier is None else earlier)])


def _range_m(sample: Sample) -> float:
    ranges = _ranges(sample)
    hit = ranges[np.isfinite(ranges)]
    return float(hit.mean()) if len(hit) else float("nan")


@lru_cache(maxsize=1)  # the measures of one sample are computed one after the other
def _difficulties(sample: Sample) -> Difficulty:
    assert sample.grid is not None
    return difficulty(sample.occupancy, sample.tudf, sample.grid.voxel_m)


def _difficulty(number: int, sample: Sample) -> float:
    return float(_difficulties(sample)[number])


def _moving(measure: Callable[[Any], Any], sample: Sample) -> float:
    """A measure of samples with movers; NaN for others."""
    return float("nan") if sample.mover_kind is None else float(measure(sample))


def _movers_seen(sample: Any) -> int:
    return np.unique(sample.return_mover[sample.return_mover >= 0]).size


MEASURES: Mapping[str, Callable[[Sample], float]] = {
    "occupied": lambda sample: float(sample.occupancy.mean()),
    "observed": lambda sample: float(sample.observed.mean()),
    "free": lambda sample: float(sample.free.mean()),
    "unknown": lambda sample: float(1 - (sample.observed | sample.free).mean()),
    "returned": lambda sample: float(np.isfinite(_ranges(sample)).mean()),
    "range_m": _range_m,
    "tudf_m": lambda sample: float(sample.tudf.mean()),
    **{name: partial(_difficulty, n) for n, name in enumerate(Difficulty._fields)},
    "ghosts": partial(_moving, lambda sample: (sample.observed & ~sample.occupancy).sum()),
    "movers_seen": partial(_moving, _movers_seen),
    "mover_returns": partial(_moving, lambda sample: (sample.return_mover >= 0).sum()),
}
"""Measures of a sample, for `inspect` and `take --where`; none is stored. Shares of voxels; the
share of rays that returned, and their mean range, metres (NaN for none); the mean distance of
voxels, metres; the difficulty of the map; and, of samples with movers, the number of voxels that
hold a return of some scan and nothing at the sample's time, of movers with a return of the sample's
own scan, and of these returns."""
COLUMNS = tuple(MEASURES)
ROW = np.dtype([(name, "<f8") for name in MEASURES])
"""Type of a sample's measures in their file."""

NUMBERS = ("sample", "world", "viewpoint")
"""Properties of a sample that are known without reading it."""
OF_WORLD = "world_"
"""Prefix of a measure: its mean over all samples of the world."""
SIGNS = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
    "=": operator.eq,
}
AT_ONCE = 1000
"""Number of samples per worker before the number of matches is checked."""
DIGEST_BYTES = 32
MEASURED_AGAIN = 5
"""Number of samples that are measured again to validate stored measures."""


def measures_file(dataset: Dataset) -> Path:
    """Path of the measures that `scenegen inspect --keep` writes beside a dataset. The name
    contains the digest, so that measures of another dataset are never used."""
    return dataset.folder / f"figures-{dataset.digest[:16]}.npy"


def encode_measures(table: Floats) -> bytes:
    """Encode measures (samples, measures) of all splits in order, followed by their SHA-256."""
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(table, "<f8").view(ROW)[:, 0])
    return file.getvalue() + hashlib.sha256(file.getvalue()).digest()


def kept_measures(dataset: AnyDataset) -> dict[str, Floats]:
    """Read stored measures.

    Args:
        dataset: A dataset, or a collection all of whose datasets have stored measures.

    Returns:
        Measures (samples, measures) by split; {} if there are none, or the file is damaged or of
            another version.

    Raises:
        DatasetError: if some samples are measured again and differ.
    """
    tables = {member.folder: _stored_measures(member) for member in dataset.datasets}
    if not all(tables.values()):
        return {}
    by_split = {}
    for name in SPLITS:
        split = dataset.split(name)
        columns = [tables[piece.dataset.folder][name][own_numbers(piece)] for piece in split.pieces]
        # an empty table first, as a split may have no pieces
        by_split[name] = np.concatenate([np.empty((0, len(COLUMNS))), *columns])
    return by_split


def own_numbers(piece: Piece) -> Ints:
    """Numbers (N,) of a piece's samples in the split of their dataset."""
    split = piece.dataset.split(piece.entry.split)
    first = split.first([other_piece.entry for other_piece in split.pieces].index(piece.entry))
    return first + (np.arange(piece.entry.samples) if piece.rows is None else piece.rows)


def _stored_measures(dataset: Dataset) -> dict[str, Floats]:
    """Stored measures of one dataset; see `kept_measures`."""
    counts = [len(dataset.split(name)) for name in SPLITS]
    path = measures_file(dataset)
    try:
        max_bytes = sum(counts) * ROW.itemsize + MAX_NPY_HEADER_BYTES + DIGEST_BYTES
        content = read_bounded(path, max_bytes)
        body, digest = content[:-DIGEST_BYTES], content[-DIGEST_BYTES:]
        # a truncated or edited file is ignored
        if hashlib.sha256(body).digest() != digest:
            return {}
        table = read_npy(body)
    except (OSError, ValueError, ScenegenError):
        return {}
    # a dtype has names: measures of a version that has others do not fit
    if table.dtype != ROW or table.shape != (sum(counts),):
        return {}
    table = table.view("<f8").reshape(-1, len(COLUMNS))
    by_split = dict(zip(SPLITS, np.split(table, np.cumsum(counts)[:-1]), strict=True))
    name = max(by_split, key=lambda name: len(by_split[name]))
    samples = len(by_split[name])
    # spread over the largest split: measures of an older version are likely to differ somewhere
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
    """A bound of one measure. A sample without the measure (NaN) does not satisfy it."""

    name: str
    sign: str
    value: float

    @classmethod
    def of(cls, text: str) -> "Condition":
        """Parse a condition such as ``occupied>=0.05``.

        Raises:
            ValueError: if it cannot be parsed.
        """
        number = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
        match = re.fullmatch(rf"\s*(\w+)\s*(<=|>=|<|>|=)\s*({number})\s*", text, re.ASCII)
        known = (*NUMBERS, *MEASURES, *(OF_WORLD + name for name in MEASURES))
        if match and match[1] in known:
            return cls(match[1], match[2], float(match[3]))
        raise ValueError(
            f"{short_repr(text)}: expected a name, a sign and a number, such as "
            "occupied>=0.05; names "
            f"are {', '.join(known)}, signs {' '.join(SIGNS)}"
        )

    def __str__(self) -> str:
        # all digits: rounded, two conditions with other samples could read alike
        return f"{self.name}{self.sign}{self.value!r}".removesuffix(".0")

    def holds(self, values: Any) -> Any:
        """Whether a value, or each of an array, satisfies the condition."""
        return SIGNS[self.sign](values, self.value)


@dataclass(frozen=True, kw_only=True)
class SelectionCriteria:
    """Which samples to select."""

    splits: tuple[str, ...] = SPLITS
    most: int | None = None
    """Maximum number of samples of each split; None for all."""
    kinds: tuple[str, ...] = ()
    """Kinds of worlds, such as "maze", which is of every difficulty, or "maze-hard"; a user's own
    with or without its module; empty for all."""
    worlds: tuple[tuple[int, int], ...] = ()
    """Ranges (first, one past last) of world numbers; empty for all."""
    where: tuple[Condition, ...] = ()

    def __str__(self) -> str:
        """The criteria as options of the command line, which a selection's file records."""
        words = [f"--split {split}" for split in self.splits if self.splits != SPLITS]
        words += [] if self.most is None else [f"--n {self.most}"]
        words += [f"--kind {kind}" for kind in self.kinds]
        words += [f"--worlds {','.join(f'{a}:{b}' for a, b in self.worlds)}"] if self.worlds else []
        return " ".join([*words, *(f"--where {condition}" for condition in self.where)])


def choose(
    dataset: AnyDataset, criteria: SelectionCriteria, *, workers: int = 1
) -> dict[str, Ints]:
    """Select samples. They are read only for conditions on measures that are not stored.

    Args:
        dataset: The dataset.
        criteria: Which samples.
        workers: Number of processes that measure samples.

    Returns:
        Rising sample numbers of each split.

    Raises:
        DatasetError: if stored measures are wrong, or those of whole worlds are not stored.
    """
    conditions = tuple(condition for condition in criteria.where if condition.name not in NUMBERS)
    stored = kept_measures(dataset) if conditions else {}
    # means over worlds need all samples, so they are not measured on the fly
    world_measures = [condition.name for condition in conditions if condition.name not in MEASURES]
    if world_measures and not stored:
        unmeasured = [member for member in dataset.datasets if not _stored_measures(member)]
        commands = [f"scenegen inspect {quote(str(member.folder))} --keep" for member in unmeasured]
        raise DatasetError(
            f"{dataset.name}: {world_measures[0]} is a mean over all maps of a world; measure "
            f"these first: {'; '.join(commands)}"
        )
    numbers = {}
    for name in (name for name in SPLITS if name in criteria.splits):
        split = dataset.split(name)
        candidates = _by_number(split, criteria)
        if stored:
            for condition in conditions:
                values = measure_of(split, stored[name], condition.name)
                candidates = candidates[condition.holds(values[candidates])]
        elif conditions:
            candidates = _by_measuring(split, conditions, candidates, criteria.most, workers)
        numbers[name] = candidates[: criteria.most]
    return numbers


def _by_number(split: Split, criteria: SelectionCriteria) -> Ints:
    """Samples that satisfy all conditions that are known without reading them."""
    world, viewpoint = split.numbers
    values = {"sample": np.arange(len(split)), "world": world, "viewpoint": viewpoint}
    mask = np.ones(len(split), bool)
    if criteria.kinds:
        mask[:] = False
        for number, piece in enumerate(split.pieces):
            if not _kind_names(piece.dataset.manifest).isdisjoint(criteria.kinds):
                mask[split.first(number) :][: len(piece)] = True
    if criteria.worlds:
        ranges = [(world >= first) & (world < stop) for first, stop in criteria.worlds]
        mask &= np.any(ranges, axis=0)
    for condition in criteria.where:
        if condition.name in values:
            mask &= condition.holds(values[condition.name])
    return np.flatnonzero(mask)


def _kind_names(manifest: Manifest) -> set[str]:
    """Names of a dataset's kind: with and without its difficulty, and its module."""
    kinds = manifest.kind, manifest.kind.rpartition(":")[2]
    return {kind + end for kind in kinds for end in ("", f"-{manifest.tables.difficulty}")}


def _by_measuring(
    split: Split,
    conditions: tuple[Condition, ...],
    candidates: Ints,
    max_samples: int | None,
    workers: int,
) -> Ints:
    """Samples that satisfy the conditions on measures. If more than `max_samples` do, some may be
    omitted."""
    fulfilling = list[int]()
    # in chunks: measuring stops when enough samples are found
    for chunk in chunked(candidates.tolist(), workers * AT_ONCE):
        if max_samples is not None and len(fulfilling) >= max_samples:
            break
        for number, fulfils in run(partial(_fulfils, split, conditions), chunk, workers):
            fulfilling += [number] if fulfils else []
    # sorted, as workers finish in any order and a selection has rising numbers
    return np.array(sorted(fulfilling), np.int64)


def _fulfils(split: Split, conditions: tuple[Condition, ...], number: int) -> tuple[int, bool]:
    """Number of a sample, and whether it satisfies the conditions on measures."""
    sample = split[number]
    return number, all(
        condition.holds(MEASURES[condition.name](sample)) for condition in conditions
    )


def measure_of(split: Split, table: Floats, name: str) -> Floats:
    """One measure of all samples of a split, or its mean over each sample's world.

    Args:
        split: The split.
        table: `MEASURES` (samples, measures) of its samples.
        name: The measure, perhaps with the prefix `OF_WORLD`.

    Returns:
        Values (samples,); NaN where there is none.
    """
    values = table[:, COLUMNS.index(name.removeprefix(OF_WORLD))]
    if name in MEASURES:
        return values
    worlds, valid = split.numbers[0], ~np.isnan(values)
    with np.errstate(invalid="ignore"):  # 0 / 0 gives NaN for a world without values
        means = np.bincount(worlds, np.where(valid, values, 0)) / np.bincount(worlds, valid)
    return means[worlds]


def encode_selection(
    dataset: AnyDataset, numbers: Mapping[str, Ints], criteria: SelectionCriteria, folder: Path
) -> bytes:
    """Encode a selection's file.

    Args:
        dataset: The dataset.
        numbers: Selected sample numbers of each split.
        criteria: How they were selected.
        folder: Folder of the file, from which paths are relative.
    """
    chosen: dict[Path, dict[str, list[int]]] = {member.folder: {} for member in dataset.datasets}
    for name, split_numbers in numbers.items():
        for piece in (split := dataset.split(name)).pieces_of(split_numbers.tolist()):
            local_numbers = own_numbers(piece).tolist()
            chosen[piece.dataset.folder].setdefault(split.name, []).extend(local_numbers)
    datasets = [
        SelectedDataset(
            path=name_from(folder, member.folder),
            digest=member.digest,
            samples=chosen[member.folder],
        )
        for member in dataset.datasets
        if chosen[member.folder]
    ]
    document = msgspec.to_builtins(SelectionFile(chosen_by=str(criteria), datasets=datasets))
    return (json.dumps(document) + "\n").encode()
