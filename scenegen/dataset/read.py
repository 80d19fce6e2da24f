"""Read datasets: samples by split and number, with derived fields computed, and their worlds.

A `Dataset` is one folder. `scenegen.dataset.collection` reads several, or some of their samples, as
one. Both give `Split`s.
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
from lidarsim.parameters import short_repr
from scenegen import SPLITS
from scenegen.base.errors import CorruptFileError, DatasetError, SceneError, reraise_as
from scenegen.dataset import manifest
from scenegen.dataset.archive import DOCUMENT, open_archive
from scenegen.dataset.layout import ShardFile, check_sum, open_file, open_shard
from scenegen.dataset.manifest import Manifest
from scenegen.dataset.schema import ShardEntry
from scenegen.draw.sample import Sample, SampleSequence, Schema, html_table
from scenegen.worlds.mapping import Sensing

if TYPE_CHECKING:
    from scenegen.worlds.world import AnyWorld

INCOMPLETE = "incomplete; give the command that made it again to go on where it was"


def advised(
    folder: Path, mark: str = "/", of: Any = CorruptFileError
) -> AbstractContextManager[None]:
    """Raise errors of a damaged dataset as DatasetErrors with its folder and advice.

    Args:
        folder: Folder of the dataset.
        mark: Text between the folder and the message.
        of: Classes of errors that are caught.
    """
    return reraise_as(
        DatasetError, f"{folder}{mark}", "; copy the dataset again, or generate it", of=of
    )


class Rows(NamedTuple):
    """Samples of a split by number: a task for a worker."""

    split: str
    numbers: Sequence[int]

    def __str__(self) -> str:
        return f"{self.split} samples {self.numbers[0]} to {self.numbers[-1]}"


@dataclass(frozen=True, eq=False)
class Piece:
    """Samples of a split that lie in one shard."""

    dataset: "Dataset"
    entry: ShardEntry
    rows: Ints | None = None
    """Rows of the shard, in order; None for all."""
    first_world: int = 0
    """Offset of world numbers, so that worlds of a collection have different numbers."""

    def __len__(self) -> int:
        return self.entry.samples if self.rows is None else len(self.rows)

    def row(self, position: int) -> int:
        """Row in the shard of the sample at a position in this piece."""
        return position if self.rows is None else int(self.rows[position])

    def numbers(self) -> Ints:
        """World and viewpoint numbers of its samples, (2, N). Raises CorruptFileError."""
        manifest, split = self.dataset.manifest, self.entry.split
        rows = np.arange(self.entry.samples) if self.rows is None else self.rows
        places = manifest.first_place(self.entry) + rows
        world, viewpoint = manifest.numbering(split).name(places)
        return np.array([world + self.first_world, viewpoint])


MAX_OPEN = 64
"""Maximum number of open shards of a split in a process. HDF5 takes 1.4 MB for each, and half a
millisecond to open one."""


FIRST = itemgetter(0)


class AnyDataset(ABC):
    """A `Dataset`, or a `Collection` of several."""

    name: str
    """Name for messages and reports."""
    grid: GridSpec
    """Grid of the maps."""
    lidar: Sensor
    """The sensor; if datasets differ, that of the first."""
    datasets: "tuple[Dataset, ...]"
    """The datasets that its samples come from."""

    def __init__(self) -> None:
        self._splits: dict[str, Split] = {}

    @property
    @abstractmethod
    def digest(self) -> str:
        """Identifies the samples; "None" for an incomplete dataset."""

    @property
    def kind(self) -> str:
        """Kinds of its worlds, with the difficulty unless that is medium."""
        return "+".join(dict.fromkeys(dataset.manifest.graded for dataset in self.datasets))

    @property
    def settings(self) -> tuple[Sensing, ...]:
        """How the samples of each of `datasets` were sensed."""
        return tuple(dataset.manifest.sensing for dataset in self.datasets)

    @abstractmethod
    def _pieces(self, split: str) -> "list[Piece]":
        """Samples of a split, by shard."""

    @abstractmethod
    def world(self, split: str, number: int) -> dict[str, bytes]:
        """Read the files of a world.

        Args:
            split: Name of the split.
            number: Number of the world in its split.

        Returns:
            Contents by name: the MJCF document as ``world.xml``, and files that it refers to.

        Raises:
            DatasetError: if there is no such world.
        """

    @abstractmethod
    def compile(self, split: str, number: int) -> "AnyWorld":
        """Compile a world with MuJoCo after screening it; a map is only read.

        Args:
            split: Name of the split.
            number: Number of the world in its split.

        Raises:
            DatasetError: if there is no such world, or it cannot be compiled.
        """

    def split(self, name: str) -> "Split":
        """Samples of a split: "train", "val" or "test".

        Raises:
            DatasetError: if there is no such split.
        """
        if name not in SPLITS:
            raise DatasetError(
                f"{self.name}: has no split {short_repr(name)}; expected one of {', '.join(SPLITS)}"
            )
        if name not in self._splits:  # cached: a split may have many shards
            self._splits[name] = Split(self, name, self._pieces(name))
        return self._splits[name]


class Dataset(AnyDataset):
    """A dataset folder, opened for reading.

    ``Dataset("data/pillar").split("train")[0].tudf`` is the distance field of the first training
    sample.

    Args:
        folder: The folder.
        partial: Whether an incomplete dataset is accepted.
        checked: Whether files are compared with their sums when they are opened, and samples with
            their digests: for code that makes new data from it.

    Raises:
        DatasetError: if there is no dataset, it is damaged, or incomplete and not `partial`.
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
            # computed now, so that a damaged manifest fails here and not on access
            _ = self.manifest.schema
        if not (self.manifest.complete or partial):
            raise DatasetError(f"{self.folder}: {INCOMPLETE}")

    @property
    def digest(self) -> str:
        """SHA-256 over the digests of all samples; "None" for an incomplete dataset."""
        return str(self.manifest.digest)

    def _pieces(self, split: str) -> "list[Piece]":
        return [Piece(self, entry) for entry in self.manifest.shards if entry.split == split]

    def __fspath__(self) -> str:
        return str(self.folder)

    def __repr__(self) -> str:
        return f"<Dataset: {self.kind}, seed {self.manifest.seed}, in {self.folder}>"

    def _repr_html_(self) -> str:
        """For notebooks: a table of the splits and settings."""
        rows: list[tuple[str, object]] = [
            (name, f"{len(self.split(name))} samples") for name in SPLITS
        ]
        rows += [("grid", self.grid), ("sensor", self.lidar), ("digest", self.digest)]
        return html_table(rows, self)

    def world(self, split: str, number: int) -> dict[str, bytes]:
        """Read the files of a world; see `AnyDataset.world`.

        Returns:
            Contents by name.
        """
        shards, member = self._by_world.get(split, []), f"{number:06d}.xml"
        # worlds are numbered in the order of shards: the last shard that begins before it has the
        # world, or, if worlds come again, an earlier one
        for _, shard in reversed(shards[: bisect_right(shards, number, key=FIRST)]):
            with (
                advised(self.folder),
                self._open(shard.worlds, shard.worlds_sha256) as file,
                open_archive(file, shard.worlds) as members,
            ):
                if member in members:
                    document, assets = members.world(member)
                    return {DOCUMENT: document} | assets
        raise DatasetError(f"{self.folder}: has no world {number} in its {split} split")

    def compile(self, split: str, number: int) -> "AnyWorld":
        """Compile a world; see `AnyDataset.compile`.

        Returns:
            The world.
        """
        from scenegen.worlds.screen import screen
        from scenegen.worlds.world import archived_world

        files = self.world(split, number)
        document, name = files.pop(DOCUMENT), f"{split} world {number}"
        with advised(self.folder, ": ", of=(CorruptFileError, SceneError)):
            screen(document, files, name)
            return archived_world(document, files, name=name)

    @cached_property
    def _by_world(self) -> dict[str, list[tuple[int, ShardEntry]]]:
        """Shards of each split with the numbers of their first worlds, in the order of these, for a
        binary search."""
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
        """Open a shard, and check that it belongs to this dataset. Raises DatasetError."""
        path = self.folder / entry.file
        with advised(self.folder):
            # fetches the file, and compares its sum if `checked`
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
        """Open a file that the manifest lists. If `checked`, its SHA-256 is compared once."""
        file = open_file(self.folder / name)
        if self.checked and name not in self._sound:
            try:
                check_sum(file, name, sha256)
            except CorruptFileError:
                file.close()
                raise
            # once: of a split with more than MAX_OPEN shards, each is opened again and again
            self._sound.add(name)
        return file


class Split(SampleSequence):
    """Samples of one split, in order. Files are opened on first access, again in every process."""

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
        """Read several samples; torch calls this for a batch."""
        return list(map(self._sample, indices))

    def _sample(self, index: int) -> Sample:
        number, row = self._place(index)
        piece = self.pieces[number]
        self._shard(number)  # a missing or foreign file is an error now, not on field access
        if piece.dataset.checked:
            self.check(index)
        manifest, find = piece.dataset.manifest, partial(self._find, number, row)
        return Sample.lazy(manifest.schema.names, find, lidar=manifest.lidar, grid=manifest.grid)

    def check(self, index: int) -> None:
        """Compare a sample with its stored digest; `free` and `tudf` are not covered. Raises
        DatasetError."""
        number, row = self._place(index)
        with advised(self.pieces[number].dataset.folder):
            self._shard(number).check(row)

    def __getstate__(self) -> dict[str, Any]:
        # HDF5 handles cannot be pickled
        return {**self.__dict__, "_open": {}}

    def __repr__(self) -> str:
        return f"<Split: {len(self)} samples of {self.dataset.name}, {self.name}>"

    @property
    def schema(self) -> Schema:
        """Schema of the samples; if datasets differ, that of the first."""
        return self.schemas[0]

    @cached_property
    def schemas(self) -> Sequence[Schema]:
        """Schemas of the datasets that the samples come from."""
        datasets = dict.fromkeys(piece.dataset for piece in self.pieces)
        return [dataset.manifest.schema for dataset in datasets or self.dataset.datasets]

    def _place(self, index: int) -> tuple[int, int]:
        """Number of the piece of a sample, and its row in the shard."""
        index = self._checked(index)
        number = int(np.searchsorted(self._start, index, side="right")) - 1
        return number, self.pieces[number].row(index - int(self._start[number]))

    def _shard(self, number: int) -> ShardFile:
        # HDF5 handles must not be shared with a forked process
        if self._process != os.getpid():
            self._open, self._process = {}, os.getpid()
        piece = self.pieces[number]
        shard = self._open.pop(number, None) or piece.dataset.open_shard(piece.entry)
        self._open[number] = shard  # dicts keep order: the least recently used shard comes first
        for old in list(self._open)[:-MAX_OPEN]:
            self._open.pop(old, None)  # closed when no other thread holds it
        return shard

    def _find(self, number: int, row: int, sample: Sample, name: str) -> Any:
        """Read a stored field of a sample, or derive it. Raises DatasetError."""
        piece, shard = self.pieces[number], self._shard(number)
        manifest = piece.dataset.manifest
        with advised(piece.dataset.folder):
            if name in manifest.fields:
                value = shard.value(name, row)
                # worlds of a collection are numbered across its datasets
                return value + piece.first_world if name == "world" else value
            if name == "tudf":
                # imports MuJoCo, which reading stored fields does not need
                from scenegen.truth import distance_field

                return distance_field(sample.occupancy, manifest.grid)
            with reraise_as(CorruptFileError, f"{shard.name}: sample {row}: "):
                # oldest first, as when the sample was made
                scans = sample.scans()[::-1]
                return fuse(scans, manifest.grid, sample.origin, manifest.mapping).free

    def first(self, number: int) -> int:
        """Number of a piece's first sample."""
        return int(self._start[number])

    def pieces_of(self, numbers: Sequence[int] | None, first_world: int = 0) -> list[Piece]:
        """Restrict the split to some samples.

        Args:
            numbers: Rising sample numbers; None for all.
            first_world: Offset of the world numbers.

        Returns:
            Pieces with these samples.
        """
        pieces = []
        chosen = None if numbers is None else np.asarray(numbers, np.int64)
        for number, piece in enumerate(self.pieces):
            rows = piece.rows
            if chosen is not None:
                begin, end = self._start[number : number + 2]
                begin_index, end_index = np.searchsorted(chosen, [begin, end])
                local_rows = chosen[begin_index:end_index] - begin
                rows = local_rows if piece.rows is None else piece.rows[local_rows]
            if rows is None or len(rows):
                pieces.append(Piece(piece.dataset, piece.entry, rows, first_world))
        return pieces

    def piece_numbers(self, number: int) -> Ints:
        """World and viewpoint numbers of a piece's samples, (2, N). Raises DatasetError."""
        with advised(self.pieces[number].dataset.folder):
            return self.pieces[number].numbers()

    @cached_property
    def numbers(self) -> Ints:
        """World and viewpoint numbers of all samples, (2, N). Raises DatasetError."""
        numbers = map(self.piece_numbers, range(len(self.pieces)))
        return np.concatenate([np.empty((2, 0), np.int64), *numbers], axis=1)

    def count_worlds(self) -> int:
        """Number of different worlds of its samples."""
        return len(np.unique(self.numbers[0]))

    def by_kind(self) -> dict[str, list[int]]:
        """Sample numbers by the kind of their worlds, with its difficulty."""
        numbers: dict[str, list[int]] = {}
        for first, piece in zip(self._start.tolist(), self.pieces, strict=False):
            of_kind = numbers.setdefault(piece.dataset.kind, [])
            of_kind += range(first, first + len(piece))
        return numbers

    def home(self, index: int) -> Manifest:
        """Manifest of the dataset that a sample belongs to."""
        return self.pieces[self._place(index)[0]].dataset.manifest

    @cached_property
    def names(self) -> list[tuple[str, int, int]]:
        """(split, world, viewpoint) of every sample."""
        return [(self.name, world, viewpoint) for world, viewpoint in self.numbers.T.tolist()]
