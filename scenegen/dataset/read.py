"""Read a dataset: samples by split and number, with what was left out derived, and the worlds they
come from."""

import os
from bisect import bisect_right
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import cached_property, partial
from io import BufferedReader
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lidarsim import fuse
from lidarsim.grid import Ints
from scenegen import SPLITS
from scenegen.dataset import trust
from scenegen.dataset.archive import DOCUMENT, open_archive
from scenegen.dataset.layout import ShardFile, check_sum, open_file, open_shard
from scenegen.errors import BrokenError, DatasetError, SceneError, raised_as, short
from scenegen.sample import Sample, Samples, Schema, html_table
from scenegen.truth import distance_field

if TYPE_CHECKING:  # which imports MuJoCo
    from scenegen.worlds.world import AnyWorld

MOST_OPEN = 256
"""Shards that a reader keeps open in one process; a large dataset has more than a process may
open."""


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


class Dataset:
    """A dataset folder, opened for reading.

    ``Dataset("data/pillar").split("train")[0].tudf`` is the first training sample's distance field.
    Raises DatasetError for a folder that holds none, or, unless `partial`, an incomplete one.
    Whoever writes new data from it has it `checked`: every file by its sum when it is opened, every
    sample by its digest.
    """

    def __init__(
        self,
        folder: Path | str,
        *,
        partial: bool = False,
        checked: bool = False,
    ):
        self.folder = Path(folder)
        self.checked = checked
        self._sound: set[str] = set()
        self._splits: dict[str, Split] = {}
        self.manifest = trust.load(self.folder)
        with advised(self.folder):
            self.grid, self.lidar = self.manifest.grid, self.manifest.lidar
            self.settings = self.manifest.settings
            """How the samples of each of the datasets that they were made for were sensed; `lidar`
            is that of the first."""
        if not (self.manifest.complete or partial):
            raise DatasetError(
                f"{self.folder}: incomplete; give the command that made it again to go on where "
                f"it was"
            )

    def split(self, name: str) -> "Split":
        """The samples of a split: train, val or test. Raises DatasetError for another name."""
        if name not in SPLITS:
            raise DatasetError(
                f"{self.folder}: has no split {short(name)}; expected one of {', '.join(SPLITS)}"
            )
        if name not in self._splits:  # made once: it may have very many shards
            self._splits[name] = Split(self, name)
        return self._splits[name]

    def __fspath__(self) -> str:
        return str(self.folder)

    def __repr__(self) -> str:
        return f"<Dataset: {self.manifest.graded}, seed {self.manifest.seed}, in {self.folder}>"

    def _repr_html_(self) -> str:
        """For notebooks: what the dataset is, and the samples of its splits."""
        it = self.manifest
        rows: list[tuple[str, object]] = [
            (name, f"{len(self.split(name))} samples") for name in SPLITS
        ]
        rows += [("grid", self.grid), ("sensor", self.lidar), ("digest", it.digest)]
        return html_table(rows, self)

    def world(self, split: str, number: int) -> dict[str, bytes]:
        """World `number` of `split`: its MJCF under ``world.xml``, and the files that it refers to
        by their names.

        Raises DatasetError where there is no such world.
        """
        shards = self._by_world.get(split, [])
        for first, shard in reversed(shards[: bisect_right(shards, number, key=FIRST)]):
            member = f"{number - first + shard.first_world:06d}.xml"
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
        """World `number` of `split`, screened, and compiled by MuJoCo unless it is a map. Raises
        DatasetError where there is none, or it cannot be compiled."""
        from scenegen.worlds.screen import screen
        from scenegen.worlds.world import archived_world

        files = self.world(split, number)
        document, name = files.pop(DOCUMENT), f"{split} world {number}"
        with advised(self.folder, ": ", of=(BrokenError, SceneError)):
            screen(document, files, name)
            return archived_world(document, files, name=name)

    @cached_property
    def _by_world(self) -> dict[str, list[tuple[int, trust.Entry]]]:
        """The shards of each split, with the number of the first world of each, in the order of
        these: there may be very many, of which one is looked for."""
        before = self.manifest.first_worlds
        found = [
            (before[entry.split, entry.source] + entry.first_world, entry)
            for entry in self.manifest.shards
        ]
        return {
            split: sorted((one for one in found if one[1].split == split), key=FIRST)
            for split in SPLITS
        }

    def _shard(self, entry: trust.Entry) -> ShardFile:
        """An open shard, of this dataset by its own word."""
        path = self.folder / entry.file
        home = self.manifest.home(entry)
        with advised(self.folder):
            shard = open_shard(
                self._open(entry.file, entry.sha256), path, entry.samples, home.layout
            )
            shard.check_origin(
                split=entry.split,
                first_world=entry.first_world,
                worlds_sha256=entry.worlds_sha256,
                parameters=home.fingerprint,
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


class Split(Samples):
    """The samples of one split, in order. Files are opened when first read, and anew in every
    process that reads."""

    def __init__(self, dataset: Dataset, name: str):
        self.dataset = dataset
        self.name = name
        self.shards = [shard for shard in dataset.manifest.shards if shard.split == name]
        """Its shards, as the manifest lists them."""
        self._start = np.cumsum([0, *(shard.samples for shard in self.shards)])
        self._open: dict[int, ShardFile] = {}
        self._process = os.getpid()

    def __len__(self) -> int:
        return int(self._start[-1])

    def __getitems__(self, indices: Sequence[int]) -> list[Sample]:
        """Several samples, as torch asks for a batch."""
        return list(map(self._sample, indices))

    def _sample(self, index: int) -> Sample:
        number, row = self._place(index)
        self._shard(number)  # says at once if the file is missing or not this dataset's
        if self.dataset.checked:
            self.check(index)
        home, find = self.home(index), partial(self._find, number, row)
        return Sample.lazy(home.schema.names, find, lidar=home.lidar, grid=home.grid)

    def check(self, index: int) -> None:
        """Raise DatasetError unless sample `index` has the digest that stands beside it; `free` and
        `tudf` have no part in that."""
        number, row = self._place(index)
        with advised(self.dataset.folder):
            self._shard(number).check(row)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}

    def __repr__(self) -> str:
        return f"<Split: {len(self)} samples of {self.dataset.folder}, {self.name}>"

    @property
    def schema(self) -> Schema:
        """The schema of its samples; where sources differ, that of the first."""
        return self.dataset.manifest.schema

    @property
    def schemas(self) -> Sequence[Schema]:
        """The schemas of the sources that it has samples of."""
        homes = self.dataset.manifest.homes
        return [homes[n].schema for n in sorted({shard.source for shard in self.shards})]

    def _place(self, index: int) -> tuple[int, int]:
        """Shard, and row in it, of sample `index`."""
        index = self._checked(index)
        shard = int(np.searchsorted(self._start, index, side="right")) - 1
        return shard, index - int(self._start[shard])

    def _shard(self, number: int) -> ShardFile:
        if (
            self._process != os.getpid()
        ):  # a forked process has handles of its own to close, and opens its own files
            self._open, self._process = {}, os.getpid()
        shard = self._open.pop(number, None) or self.dataset._shard(self.shards[number])
        self._open[number] = shard  # last in line: the one used longest ago stands first
        for old in list(self._open)[:-MOST_OPEN]:
            self._open.pop(old, None)  # closed once no other thread reads from it
        return shard

    def _find(self, number: int, row: int, sample: Sample, name: str) -> Any:
        """A field of the sample in a row of a shard: as it is stored, or derived from the other
        fields. Raises DatasetError."""
        it, shard = self.dataset, self._shard(number)
        home = it.manifest.home(self.shards[number])
        with advised(it.folder):
            if name in home.fields:
                value = shard.value(name, row)
                return value + self.first_worlds[number] if name == "world" else value
            if name == "tudf":
                return distance_field(sample.occupancy, it.grid)
            with raised_as(BrokenError, f"{shard.name}: sample {row}: "):
                return fuse(sample.scans()[::-1], it.grid, sample.origin, home.mapping).free

    @cached_property
    def first_worlds(self) -> list[int]:
        """What is added to the numbers of worlds that a shard holds, by shard."""
        first = self.dataset.manifest.first_worlds
        return [first[self.name, entry.source] for entry in self.shards]

    def first(self, number: int) -> int:
        """The number of a shard's first sample."""
        return int(self._start[number])

    def places(self, number: int) -> Ints:
        """Where a shard's samples, (N,), stand in the split of the dataset that they were made for.
        Raises DatasetError."""
        entry = self.shards[number]
        if not entry.cut:
            return np.arange(entry.start, entry.stop)
        shard = self._shard(number)
        with advised(self.dataset.folder):
            numbering = self.dataset.manifest.home(entry).numbering(self.name)
            return numbering.place(shard.column("world"), shard.column("viewpoint"))

    def numbers_in(self, number: int) -> Ints:
        """World and viewpoint of a shard's samples, (2, N). Raises DatasetError."""
        with advised(self.dataset.folder):
            numbering = self.dataset.manifest.home(self.shards[number]).numbering(self.name)
        world, viewpoint = numbering.name(self.places(number))
        return np.array([world + self.first_worlds[number], viewpoint])

    @cached_property
    def numbers(self) -> Ints:
        """World and viewpoint of all samples, (2, samples); files are opened only where samples
        were left out between others. Raises DatasetError."""
        found = map(self.numbers_in, range(len(self.shards)))
        return np.concatenate([np.empty((2, 0), np.int64), *found], axis=1)

    def count_worlds(self) -> int:
        """How many worlds its samples are of."""
        return len(np.unique(self.numbers[0]))

    def by_kind(self) -> dict[str, list[int]]:
        """The numbers of its samples by the kind of their worlds, and its difficulty."""
        found: dict[str, list[int]] = {}
        for first, entry in zip(self._start.tolist(), self.shards, strict=False):
            ours = found.setdefault(self.dataset.manifest.home(entry).graded, [])
            ours += range(first, first + entry.samples)
        return found

    def home(self, index: int) -> trust.Manifest:
        """What sample `index` was made for: this dataset, or one that it was taken from."""
        return self.dataset.manifest.home(self.shards[self._place(index)[0]])

    @cached_property
    def names(self) -> list[tuple[str, int, int]]:
        """(split, world, viewpoint) of every sample."""
        return [(self.name, world, viewpoint) for world, viewpoint in self.numbers.T.tolist()]
