"""Read datasets: samples by split and number, with what was left out derived, and the worlds they
come from.

A `Dataset` is a folder; `scenegen.dataset.collection` has several, or some of their samples, read
as one. Both give `Split`s.
"""

import os
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property, partial
from io import BufferedReader
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lidarsim import GridSpec, Sensor, fuse
from lidarsim.grid import Ints
from scenegen import SPLITS
from scenegen.base.errors import BrokenError, DatasetError, SceneError, raised_as, short
from scenegen.dataset import manifest
from scenegen.dataset.archive import DOCUMENT, open_archive
from scenegen.dataset.layout import ShardFile, check_sum, open_file, open_shard
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import ShardEntry
from scenegen.draw.sample import Sample, Samples, Schema, html_table
from scenegen.truth import distance_field
from scenegen.worlds.mapping import Sensing

if TYPE_CHECKING:  # which imports MuJoCo
    from scenegen.worlds.world import AnyWorld

MOST_OPEN = 64
"""Shards that a reader keeps open in one process. HDF5 takes 1.4 MB for each, and half a
millisecond to open one."""


FIRST = itemgetter(0)


def advised(folder: Path, mark: str = "/", of: Any = BrokenError) -> AbstractContextManager[None]:
    """Say of what is broken in the dataset in `folder` where it is, and what to do about it."""
    return raised_as(
        DatasetError, f"{folder}{mark}", "; copy the dataset again, or generate it", of=of
    )


class Rows(NamedTuple):
    """Samples of a split by their numbers: a task for a worker."""

    split: str
    numbers: Sequence[int]

    def __str__(self) -> str:
        return f"{self.split} samples {self.numbers[0]} to {self.numbers[-1]}"


class AnyDataset(ABC):
    """What is read by split: a `Dataset`, or a `Collection` of several."""

    name: str
    """What errors and reports call it."""
    grid: GridSpec
    """The grid of its maps."""
    lidar: Sensor
    """The sensor; the first dataset's, where they differ."""
    datasets: "tuple[Dataset, ...]"
    """The datasets that it has samples of."""

    def __init__(self) -> None:
        self._splits: dict[str, Split] = {}

    @property
    @abstractmethod
    def digest(self) -> str:
        """What tells its samples from all others; "None" of an incomplete dataset."""

    @property
    def kind(self) -> str:
        """The kinds of its worlds, with the difficulty where that is not medium."""
        return "+".join(dict.fromkeys(dataset.manifest.graded for dataset in self.datasets))

    @property
    def settings(self) -> tuple[Sensing, ...]:
        """How the samples of each of the `datasets` were sensed."""
        return tuple(dataset.manifest.sensing for dataset in self.datasets)

    @abstractmethod
    def _pieces(self, split: str) -> "list[Piece]":
        """The samples of a split."""

    @abstractmethod
    def world(self, split: str, number: int) -> dict[str, bytes]:
        """World `number` of `split`: its MJCF under ``world.xml``, and the files that it refers to
        by their names.

        Raises DatasetError where there is no such world.
        """

    @abstractmethod
    def compile(self, split: str, number: int) -> "AnyWorld":
        """World `number` of `split`, screened, and compiled by MuJoCo unless it is a map. Raises
        DatasetError where there is none, or it cannot be compiled."""

    def split(self, name: str) -> "Split":
        """The samples of a split: train, val or test. Raises DatasetError for another name."""
        if name not in SPLITS:
            raise DatasetError(
                f"{self.name}: has no split {short(name)}; expected one of {', '.join(SPLITS)}"
            )
        if name not in self._splits:  # made once: it may have many shards
            self._splits[name] = Split(self, name, self._pieces(name))
        return self._splits[name]


class Dataset(AnyDataset):
    """A dataset folder, opened for reading.

    ``Dataset("data/pillar").split("train")[0].tudf`` is the first training sample's distance field.

    Args:
        folder: The folder.
        partial: Whether an incomplete dataset is opened, too.
        checked: Whether every file is held against its sum when it is opened, and every sample
            against its digest: for who writes new data from it.

    Raises:
        DatasetError: The folder holds no dataset, or, unless `partial`, an incomplete one.
    """

    def __init__(self, folder: Path | str, *, partial: bool = False, checked: bool = False):
        super().__init__()
        self.folder, self.name = Path(folder), str(folder)
        self.datasets = (self,)
        self.checked = checked
        self._sound: set[str] = set()
        self.manifest = manifest.load(self.folder)
        with advised(self.folder):
            self.grid, self.lidar = self.manifest.grid, self.manifest.lidar
            _ = self.manifest.schema
        if not (self.manifest.complete or partial):
            raise DatasetError(
                f"{self.folder}: incomplete; give the command that made it again to go on where "
                f"it was"
            )

    @property
    def digest(self) -> str:
        """SHA-256 over the digests of all samples; "None" of an incomplete one."""
        return str(self.manifest.digest)

    def _pieces(self, split: str) -> "list[Piece]":
        return [Piece(self, entry) for entry in self.manifest.shards if entry.split == split]

    def __fspath__(self) -> str:
        return str(self.folder)

    def __repr__(self) -> str:
        return f"<Dataset: {self.kind}, seed {self.manifest.seed}, in {self.folder}>"

    def _repr_html_(self) -> str:
        """For notebooks: what the dataset is, and the samples of its splits."""
        rows: list[tuple[str, object]] = [
            (name, f"{len(self.split(name))} samples") for name in SPLITS
        ]
        rows += [("grid", self.grid), ("sensor", self.lidar), ("digest", self.digest)]
        return html_table(rows, self)

    def world(self, split: str, number: int) -> dict[str, bytes]:
        """See `AnyDataset.world`."""
        shards, member = self._by_world.get(split, []), f"{number:06d}.xml"
        for _, shard in reversed(shards[: bisect_right(shards, number, key=FIRST)]):
            with (
                advised(self.folder),
                self._open(shard.worlds, shard.worlds_sha256) as file,
                open_archive(file, shard.worlds) as members,
            ):
                if member in members:
                    document, others = members.world(member)
                    return {DOCUMENT: document} | others
        raise DatasetError(f"{self.folder}: has no world {number} in its {split} split")

    def compile(self, split: str, number: int) -> "AnyWorld":
        """See `AnyDataset.compile`."""
        from scenegen.worlds.screen import screen
        from scenegen.worlds.world import archived_world

        files = self.world(split, number)
        document, name = files.pop(DOCUMENT), f"{split} world {number}"
        with advised(self.folder, ": ", of=(BrokenError, SceneError)):
            screen(document, files, name)
            return archived_world(document, files, name=name)

    @cached_property
    def _by_world(self) -> dict[str, list[tuple[int, ShardEntry]]]:
        """The shards of each split, with the number of the first world of each, in the order of
        these: there may be very many, of which one is looked for."""
        return {
            split: sorted(
                (
                    (entry.first_world, entry)
                    for entry in self.manifest.shards
                    if entry.split == split
                ),
                key=FIRST,
            )
            for split in SPLITS
        }

    def open_shard(self, entry: ShardEntry) -> ShardFile:
        """An open shard, of this dataset by its own word. Raises DatasetError."""
        path = self.folder / entry.file
        with advised(self.folder):
            self._open(entry.file, entry.sha256).close()
            shard = open_shard(path, entry.samples, self.manifest.layout)
            shard.check_origin(
                split=entry.split,
                first_world=entry.first_world,
                worlds_sha256=entry.worlds_sha256,
                parameters=self.manifest.fingerprint,
            )
        return shard

    def _open(self, name: str, sha256: str) -> BufferedReader:
        """A file that the manifest lists; if `checked`, its sum is held against the list, once."""
        file = open_file(self.folder / name)
        if self.checked and name not in self._sound:
            try:
                check_sum(file, name, sha256)
            except BrokenError:
                file.close()
                raise
            self._sound.add(name)
        return file


@dataclass(frozen=True, eq=False)
class Piece:
    """The samples of one shard that a split has."""

    dataset: Dataset
    entry: ShardEntry
    rows: Ints | None = None
    """The rows of the shard that are taken, in order; None for all."""
    first_world: int = 0
    """What is added to the numbers of its worlds, so that those of a collection differ."""

    def __len__(self) -> int:
        return self.entry.samples if self.rows is None else len(self.rows)

    def row(self, within: int) -> int:
        """The shard's row of one of its samples."""
        return within if self.rows is None else int(self.rows[within])

    def names(self) -> Ints:
        """World and viewpoint of its samples, (2, N). Raises BrokenError."""
        manifest, split = self.dataset.manifest, self.entry.split
        rows = np.arange(self.entry.samples) if self.rows is None else self.rows
        places = manifest.first_place(self.entry) + rows
        world, viewpoint = manifest.numbering(split).name(places)
        return np.array([world + self.first_world, viewpoint])


class Split(Samples):
    """The samples of one split, in order. Files are opened when first read, and anew in every
    process that reads."""

    def __init__(self, dataset: AnyDataset, name: str, pieces: Sequence[Piece]):
        self.dataset = dataset
        self.name = name
        self.pieces = tuple(pieces)
        self._start = np.cumsum([0, *map(len, pieces)])
        self._open: dict[int, ShardFile] = {}
        self._process = os.getpid()

    def __len__(self) -> int:
        return int(self._start[-1])

    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Several samples, as torch asks for a batch."""
        return list(map(self._sample, indices))

    def _sample(self, index: int) -> Sample:
        number, row = self._place(index)
        piece = self.pieces[number]
        self._shard(number)  # says at once if the file is missing or not this dataset's
        if piece.dataset.checked:
            self.check(index)
        manifest, find = piece.dataset.manifest, partial(self._find, number, row)
        return Sample.lazy(manifest.schema.names, find, lidar=manifest.lidar, grid=manifest.grid)

    def check(self, index: int) -> None:
        """Raise DatasetError unless sample `index` has the digest that stands beside it; `free` and
        `tudf` have no part in that."""
        number, row = self._place(index)
        with advised(self.pieces[number].dataset.folder):
            self._shard(number).check(row)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}

    def __repr__(self) -> str:
        return f"<Split: {len(self)} samples of {self.dataset.name}, {self.name}>"

    @property
    def schema(self) -> Schema:
        """The schema of its samples; where datasets differ, that of the first."""
        return self.schemas[0]

    @cached_property
    def schemas(self) -> Sequence[Schema]:
        """The schemas of the datasets that it has samples of."""
        datasets = dict.fromkeys(piece.dataset for piece in self.pieces)
        return [one.manifest.schema for one in datasets or self.dataset.datasets]

    def _place(self, index: int) -> tuple[int, int]:
        """The number of the piece with sample `index`, and the row in its shard."""
        index = self._checked(index)
        number = int(np.searchsorted(self._start, index, side="right")) - 1
        return number, self.pieces[number].row(index - int(self._start[number]))

    def _shard(self, number: int) -> ShardFile:
        if (
            self._process != os.getpid()
        ):  # a forked process has handles of its own to close, and opens its own files
            self._open, self._process = {}, os.getpid()
        piece = self.pieces[number]
        shard = self._open.pop(number, None) or piece.dataset.open_shard(piece.entry)
        self._open[number] = shard  # last in line: the one used longest ago stands first
        for old in list(self._open)[:-MOST_OPEN]:
            self._open.pop(old, None)  # closed once no other thread reads from it
        return shard

    def _find(self, number: int, row: int, sample: Sample, name: str) -> Any:
        """A field of the sample in a row of a shard: as it is stored, or derived from the other
        fields. Raises DatasetError."""
        piece, shard = self.pieces[number], self._shard(number)
        manifest = piece.dataset.manifest
        with advised(piece.dataset.folder):
            if name in manifest.fields:
                value = shard.value(name, row)
                return value + piece.first_world if name == "world" else value
            if name == "tudf":
                return distance_field(sample.occupancy, manifest.grid)
            with raised_as(BrokenError, f"{shard.name}: sample {row}: "):
                scans = sample.scans()[::-1]
                return fuse(scans, manifest.grid, sample.origin, manifest.mapping).free

    def first(self, number: int) -> int:
        """The number of a piece's first sample."""
        return int(self._start[number])

    def taken(self, numbers: Sequence[int] | None, first_world: int = 0) -> list[Piece]:
        """The pieces with the samples `numbers` alone, rising, or with all; `first_world` is added
        to the numbers of their worlds."""
        pieces = []
        chosen = None if numbers is None else np.asarray(numbers, np.int64)
        for number, piece in enumerate(self.pieces):
            rows = piece.rows
            if chosen is not None:
                begin, end = self._start[number : number + 2]
                low, high = np.searchsorted(chosen, [begin, end])
                within = chosen[low:high] - begin
                rows = within if piece.rows is None else piece.rows[within]
            if rows is None or len(rows):
                pieces.append(Piece(piece.dataset, piece.entry, rows, first_world))
        return pieces

    def names_in(self, number: int) -> Ints:
        """World and viewpoint of a piece's samples, (2, N). Raises DatasetError."""
        with advised(self.pieces[number].dataset.folder):
            return self.pieces[number].names()

    @cached_property
    def numbers(self) -> Ints:
        """World and viewpoint of all samples, (2, samples). Raises DatasetError."""
        names = map(self.names_in, range(len(self.pieces)))
        return np.concatenate([np.empty((2, 0), np.int64), *names], axis=1)

    def count_worlds(self) -> int:
        """How many worlds its samples are of."""
        return len(np.unique(self.numbers[0]))

    def by_kind(self) -> dict[str, list[int]]:
        """The numbers of its samples by the kind of their worlds, and its difficulty."""
        numbers: dict[str, list[int]] = {}
        for first, piece in zip(self._start.tolist(), self.pieces, strict=False):
            of_kind = numbers.setdefault(piece.dataset.kind, [])
            of_kind += range(first, first + len(piece))
        return numbers

    def home(self, index: int) -> Manifest:
        """The manifest of the dataset that sample `index` is of."""
        return self.pieces[self._place(index)[0]].dataset.manifest

    @cached_property
    def names(self) -> list[tuple[str, int, int]]:
        """(split, world, viewpoint) of every sample."""
        return [(self.name, world, viewpoint) for world, viewpoint in self.numbers.T.tolist()]
