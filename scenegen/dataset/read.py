"""Read a dataset: samples by split and number, with what was left out derived, and the worlds they come from."""

import os
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np

from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.archive import open_archive
from scenegen.dataset.layout import ShardFile, layout_of, open_file, open_shard
from scenegen.dataset.sensor import sensor_of
from scenegen.dataset.trust import Entry, check_manifest
from scenegen.errors import BrokenError, DatasetError, short
from scenegen.sample import Sample, derive_free, derive_tudf, describe_fields

MOST_OPEN = 64
"""Shards that a reader keeps open in one process; a large dataset has more than a process may open."""


class Dataset:
    """A dataset folder, opened for reading.

    ``Dataset("data/pillar").split("train")[0].tudf`` is the first training sample's distance field. Raises DatasetError
    for a folder that holds none, or, unless `partial`, an incomplete one.
    """

    def __init__(self, folder: Path | str, *, partial: bool = False):
        self.folder = Path(folder)
        self.manifest = manifest.read(self.folder)
        checked, self.grid = check_manifest(self.manifest, str(self.folder))
        with self._advice():
            self.lidar = sensor_of(self.manifest["lidar"], self.folder)
        self._entries = checked.shards
        self._fingerprint = manifest.fingerprint_of(self.manifest)
        if not (checked.complete or partial):
            raise DatasetError(f"{self.folder}: incomplete; give the command that made it again to go on where it was")

    def split(self, name: str) -> "Split":
        """The samples of a split: train, val or test. Raises DatasetError for another name."""
        if name not in SPLITS:
            raise DatasetError(f"{self.folder}: has no split {short(name)}; expected one of {', '.join(SPLITS)}")
        return Split(self, name)

    def world(self, split: str, number: int) -> dict[str, bytes]:
        """World `number` of `split`: its MJCF under ``world.xml``, and the files that it refers to by their names.

        Raises DatasetError where there is no such world.
        """
        member = f"{number:06d}.xml"
        for shard in self._entries:
            if shard.split != split or shard.first_world > number:
                continue
            with (
                self._advice(),
                open_file(self.folder / shard.worlds) as file,
                open_archive(file, shard.worlds) as members,
            ):
                if member in members:
                    document, others = members.world(member)
                    return {"world.xml": document} | others
        raise DatasetError(f"{self.folder}: has no world {number} in its {split} split")

    def _shard(self, entry: Entry) -> ShardFile:
        """An open shard, of this dataset by its own word; its file is closed once nobody holds it any more."""
        with self._advice():
            path = self.folder / entry.file
            file = open_file(path)
            try:
                layout = layout_of(self.manifest["fields"], self.grid, self.lidar)
                shard = open_shard(file, path, entry.samples, layout)
                shard.check_origin(
                    split=entry.split,
                    first_world=entry.first_world,
                    worlds_sha256=entry.worlds_sha256,
                    parameters=self._fingerprint,
                )
            except BaseException:
                file.close()
                raise
        weakref.finalize(shard, file.close)
        return shard

    @contextmanager
    def _advice(self) -> Iterator[None]:
        """Say of a broken file where it is, and what to do about it."""
        try:
            yield
        except BrokenError as error:
            raise DatasetError(f"{self.folder}/{error}; copy the dataset again, or generate it") from None


class Split(Sequence[Sample]):
    """The samples of one split, in order. Files are opened when first read, and anew in every process that reads."""

    def __init__(self, dataset: Dataset, name: str):
        self.dataset = dataset
        self.name = name
        self._shards = [shard for shard in dataset._entries if shard.split == name]
        self._start = np.cumsum([0, *(shard.samples for shard in self._shards)])
        self._open: dict[int, ShardFile] = {}
        self._process = os.getpid()

    def __len__(self) -> int:
        return int(self._start[-1])

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return [self[n] for n in range(*index.indices(len(self)))]
        return self._sample(*self._place(index))

    def __iter__(self) -> Iterator[Sample]:
        return (self[n] for n in range(len(self)))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}

    def describe(self) -> dict[str, dict[str, Any]]:
        """What a sample holds: name of each field to its `dtype`, `shape`, `unit` and `meaning`."""
        return describe_fields(self.dataset.grid, self.dataset.lidar)

    def stored(self, index: int, *names: str) -> tuple[Any, ...]:
        """Fields of one sample as they are stored, and no others: an array or a number for each of `names`.

        Raises IndexError, or DatasetError for a field that the dataset does not store or that is damaged.
        """
        absent = [name for name in names if name not in self.dataset.manifest["fields"]]
        if absent:
            raise DatasetError(f"{self.dataset.folder}: stores no {', '.join(absent)}")
        number, row = self._place(index)
        shard = self._shard(number)
        with self.dataset._advice():
            return tuple(shard.value(name, row) for name in names)

    def _place(self, index: int) -> tuple[int, int]:
        """Shard, and row in it, of sample `index`."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)} in {self.dataset.folder}, split {self.name}")
        index %= len(self)
        shard = int(np.searchsorted(self._start, index, side="right")) - 1
        return shard, index - int(self._start[shard])

    def _shard(self, number: int) -> ShardFile:
        if self._process != os.getpid():  # a forked process has handles of its own to close, and opens its own files
            self._open, self._process = {}, os.getpid()
        shard = self._open.pop(number, None) or self.dataset._shard(self._shards[number])
        self._open[number] = shard  # last in line: the one used longest ago stands first
        for old in list(self._open)[:-MOST_OPEN]:
            self._open.pop(old, None)  # closed once no other thread reads from it
        return shard

    def _sample(self, number: int, row: int) -> Sample:
        shard = self._shard(number)
        grid, lidar = self.dataset.grid, self.dataset.lidar
        with self.dataset._advice():
            stored = {name: shard.value(name, row) for name in self.dataset.manifest["fields"]}
            if "free" not in stored:
                pose = {name: stored[name] for name in ("ranges", "position", "quaternion", "origin")}
                try:
                    if not np.isfinite(pose["origin"]).all() or not (pose["ranges"] >= 0).all():
                        raise ValueError("origin or ranges are no lengths")
                    stored["free"] = derive_free(**pose, lidar=lidar, grid=grid)
                except ValueError as error:
                    raise BrokenError(f"{shard.name}: sample {row}: {error}") from None
            if "tudf" not in stored:
                stored["tudf"] = derive_tudf(stored["occupancy"], grid=grid)
        return Sample(**stored)

    @cached_property
    def names(self) -> list[tuple[str, int, int]]:
        """Who is who: (split, world, viewpoint) of every sample."""
        found = []
        for number in range(len(self._shards)):
            shard = self._shard(number)
            with self.dataset._advice():
                worlds, viewpoints = shard.column("world").tolist(), shard.column("viewpoint").tolist()
            found += [(self.name, world, viewpoint) for world, viewpoint in zip(worlds, viewpoints, strict=True)]
        return found
