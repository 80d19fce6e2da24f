"""Read a dataset: samples by split and number, with what was left out derived, and the worlds they come from."""

import os
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import h5py
import isal.isal_zlib
import numpy as np

from scenegen import SPLITS
from scenegen.dataset import manifest
from scenegen.dataset.trust import check_manifest, check_shard, read_member
from scenegen.errors import DatasetError
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
        self.grid, self.lidar = check_manifest(self.manifest, str(self.folder))
        if not (self.manifest["complete"] or partial):
            raise DatasetError(f"{self.folder}: incomplete; give the command that made it again to go on where it was")

    def split(self, name: str) -> "Split":
        """The samples of a split: train, val or test. Raises DatasetError for another name."""
        if name not in SPLITS:
            raise DatasetError(f"{self.folder}: has no split {name!r}; expected one of {', '.join(SPLITS)}")
        return Split(self, name)

    def world(self, split: str, number: int) -> dict[str, bytes]:
        """World `number` of `split`: its MJCF under ``world.xml``, and the files that it refers to by their names.

        Raises DatasetError where there is no such world.
        """
        member = f"{number:06d}.xml"
        for shard in self.manifest["shards"]:
            if shard["split"] != split or shard["first_world"] > number:
                continue
            path = self._file(shard["worlds"])
            try:
                with zipfile.ZipFile(path) as archive:
                    names = archive.namelist()
                    if member in names:
                        document = read_member(archive, member)
                        others = [name for name in names if not name.endswith(".xml") and name.encode() in document]
                        return {"world.xml": document} | {name: read_member(archive, name) for name in others}
            except (zipfile.BadZipFile, zlib.error, OSError, ValueError, RuntimeError, EOFError) as error:
                raise DatasetError(f"{path}: is damaged ({error}); copy the dataset again, or generate it") from None
        raise DatasetError(f"{self.folder}: has no world {number} in its {split} split")

    def _file(self, name: str) -> Path:
        path = self.folder / name
        if Path(name).name != name or not path.is_file():
            raise DatasetError(
                f"{path}: is missing, though {manifest.NAME} lists it; copy the dataset again, or generate it"
            )
        return path


class Split(Sequence[Sample]):
    """The samples of one split, in order. Files are opened when first read, and anew in every process that reads."""

    def __init__(self, dataset: Dataset, name: str):
        self.dataset = dataset
        self.name = name
        self._shards = [shard for shard in dataset.manifest["shards"] if shard["split"] == name]
        self._start = np.cumsum([0, *(shard["samples"] for shard in self._shards)])
        self._open: dict[int, h5py.File] = {}
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
        shard, row = self._place(index)
        file = self._shard(shard)
        return tuple(self._value(file, name, row) for name in names)

    def _place(self, index: int) -> tuple[int, int]:
        """Shard, and row in it, of sample `index`."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)} in {self.dataset.folder}, split {self.name}")
        index %= len(self)
        shard = int(np.searchsorted(self._start, index, side="right")) - 1
        return shard, index - int(self._start[shard])

    def _shard(self, number: int) -> h5py.File:
        if self._process != os.getpid():  # a fork shares its parent's handles, and their positions in the file
            self._open, self._process = {}, os.getpid()
        file = self._open.pop(number, None)
        if file is None:
            path = self.dataset._file(self._shards[number]["file"])
            try:
                file = h5py.File(path, "r")
                here = self.dataset
                check_shard(file, here.manifest["fields"], self._shards[number]["samples"], here.grid, here.lidar)
            except (OSError, RuntimeError, KeyError, TypeError) as error:
                raise DatasetError(f"{path}: is damaged ({error}); copy the dataset again, or generate it") from None
        self._open[number] = file  # last in line: the one used longest ago stands first
        for old in list(self._open)[:-MOST_OPEN]:
            self._open.pop(old, None)  # closed once no other thread reads from it
        return file

    def _value(self, file: h5py.File, name: str, row: int) -> Any:
        """One row of a field. A chunk that is gzip alone is unpacked by isal, at several times HDF5's speed."""
        dataset = file[name]
        try:
            if dataset.chunks == (1, *dataset.shape[1:]) and dataset.id.get_create_plist().get_nfilters() == 1:
                mask, chunk = dataset.id.read_direct_chunk((row,) + (0,) * (dataset.ndim - 1))
                if dataset.compression == "gzip" and mask == 0:
                    size = dataset.dtype.itemsize * int(np.prod(dataset.chunks))
                    values = isal.isal_zlib.decompressobj().decompress(chunk, size + 1)  # no more, whatever is in it
                    return np.frombuffer(values, dtype=dataset.dtype).reshape(dataset.shape[1:]).copy()
            return dataset[row]
        except (OSError, ValueError, RuntimeError, isal.isal_zlib.error) as error:
            raise DatasetError(
                f"{file.filename}: {name}[{row}] is damaged ({error}); copy the dataset again, or generate it"
            ) from None

    def _sample(self, shard: int, row: int) -> Sample:
        file = self._shard(shard)
        stored = {name: self._value(file, name, row) for name in self.dataset.manifest["fields"]}
        grid, lidar = self.dataset.grid, self.dataset.lidar
        if "free" not in stored:
            pose = {name: stored[name] for name in ("ranges", "position", "quaternion", "origin")}
            stored["free"] = derive_free(**pose, lidar=lidar, grid=grid)
        if "tudf" not in stored:
            stored["tudf"] = derive_tudf(stored["occupancy"], grid=grid)
        return Sample(**stored)

    @cached_property
    def names(self) -> list[tuple[str, int, int]]:
        """Who is who: (split, world, viewpoint) of every sample."""
        found = []
        for number in range(len(self._shards)):
            file = self._shard(number)
            found += [(self.name, int(w), int(v)) for w, v in zip(file["world"][:], file["viewpoint"][:], strict=True)]
        return found
