"""A shard's HDF5 file, held against the format before any sample is read; then read chunk by chunk,
each into no more bytes than it may have. Reading, resuming, verifying and training all go through
here."""

import json
import math
import sys
import weakref
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any

import isal.isal_zlib
import numpy as np

from scenegen.dataset.hdf5 import Hdf5Error, Stored, read_index
from scenegen.dataset.rules import REJECTED, check
from scenegen.errors import BrokenError, DatasetError, raised_as, short
from scenegen.files import open_bounded, pread, sha256_in, size_of
from scenegen.mirrors import fetch
from scenegen.sample import DERIVED, FIELDS, Sample, Schema

DIGEST = "sha256"
"""Name of the dataset that holds the samples' own digests, uint8 (N, 32)."""
FILTERS = {DEFLATE := 1, SHUFFLE := 2, FLETCHER32 := 3}
"""HDF5's numbers of the filters that a shard may use."""

Layout = Mapping[str, tuple[np.dtype, tuple[int, ...]]]
"""Every dataset that a shard has to hold: its type, and the shape of one sample."""


def layout_of(fields: Iterable[str], schema: Schema) -> Layout:
    """The layout of a shard that stores `fields` of samples of that schema."""
    found = {name: (np.dtype(FIELDS[name]["dtype"]), schema.shape(name)) for name in fields}
    return {**found, DIGEST: (np.dtype(np.uint8), (32,))}


def most_bytes(layout: Layout, samples: int) -> int:
    """What a shard of `samples` may take on disk, however badly it is packed."""
    each = sum(dtype.itemsize * math.prod(shape) + 2000 for dtype, shape in layout.values())
    return samples * (each + each // 100) + (1 << 20)


@dataclass(frozen=True, eq=False)
class ShardFile:
    """An open shard whose layout is as the format says. Any number of threads may read from it."""

    file: BufferedReader
    name: str
    columns: Mapping[str, Stored]
    """The file's HDF5 datasets by name: N chunks each, one a sample."""
    attributes: Mapping[str, int | str | None]

    def value(self, name: str, row: int, *, read_only: bool = False) -> Any:
        """A sample's field. `read_only` saves a copy, but kernels are compiled for arrays that can
        be written.

        Raises BrokenError for a chunk that does not unpack to just what it should.
        """
        column, where = self.columns[name], f"{self.name}: sample {row}: {name}"
        _, begin, size, left_out = column.places[row].tolist()
        failed = (isal.isal_zlib.error, EOFError, ValueError, OSError)
        with raised_as(BrokenError, f"{where} cannot be unpacked: ", of=failed):
            raw = unpack(pread(self.file, size, begin), column, left_out)
        flags = column.dtype == np.bool_
        values = np.frombuffer(
            raw if read_only else bytearray(raw), np.uint8 if flags else column.dtype
        )
        if flags and values.max(initial=0) > 1:
            raise BrokenError(f"{where} holds bytes other than 0 and 1")
        # a single value is a number, and no array
        return values.view(column.dtype).reshape(column.shape[1:])[()]

    def column(self, name: str) -> np.ndarray:
        """A field of all samples, (N, ...). Raises BrokenError."""
        rows = range(len(self.columns[name].places))
        return np.stack([self.value(name, row, read_only=True) for row in rows])

    def check(self, row: int) -> None:
        """Raise BrokenError unless a sample has the digest that stands beside it; fields that
        follow from others have no part in it."""
        nothing: dict[str, Any] = {name: np.empty(0, FIELDS[name]["dtype"]) for name in DERIVED}
        stored = [name for name in self.columns if name not in (DIGEST, *DERIVED)]
        values = {name: self.value(name, row, read_only=True) for name in stored}
        sample = Sample(**nothing, **values)
        if sample.sha256() != self.value(DIGEST, row).tobytes():
            raise BrokenError(
                f"{self.name}: sample {row}: its content does not have the digest stored beside it"
            )

    @property
    def stray_bytes(self) -> int:
        """Bytes of the file beyond those of samples and what the format needs at most: an index
        entry a chunk, and some kilobytes."""
        stored = sum(int(column.places[:, 2].sum()) for column in self.columns.values())
        entries = sum(len(column.places) for column in self.columns.values())
        return max(size_of(self.file) - stored - 200 * entries - (1 << 20), 0)

    def check_origin(self, **expected: int | str) -> None:
        """Raise BrokenError where an attribute of the shard is not as `expected`."""
        for name, value in expected.items():
            if self.attributes.get(name) != value:
                raise BrokenError(
                    f"{self.name}: was written with {name} {short(self.attributes.get(name))}, "
                    f"the manifest's is "
                    f"{value!r}: one of the two was edited, or the shard is another dataset's"
                )

    def rejected(self) -> dict[str, Counter[str]]:
        """Rejections by reason, of worlds and of viewpoints. Raises BrokenError."""
        text = self.attributes.get("rejected")
        fault = f"{self.name}: attribute rejected = {short(text)}: expected counts as JSON"
        failed = (ValueError, TypeError, RecursionError, BrokenError)
        with raised_as(lambda _: BrokenError(fault), of=failed):
            given = json.loads(text)  # type: ignore[arg-type]
            check(given, REJECTED, "")
        return {what: Counter(given[what]) for what in REJECTED}


def unpack(packed: bytes, column: Stored, left_out: int) -> bytes:
    """A chunk's bytes with the filters undone, last first. Raises ValueError unless as many come
    out as there must."""
    data, size = packed, column.row_bytes
    for place in reversed(range(len(column.filters))):
        if left_out >> place & 1:
            continue
        number = column.filters[place]
        if number == FLETCHER32:
            data = data[:-4]  # its checksum is not looked at: the samples' digests are better ones
        elif number == SHUFFLE:
            data = np.frombuffer(data, np.uint8).reshape(column.dtype.itemsize, -1).T.tobytes()
        elif number == DEFLATE:
            unpacking = isal.isal_zlib.decompressobj()
            data = unpacking.decompress(data, size + 8)
            if not unpacking.eof:
                raise ValueError("more or fewer bytes than it should")
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes, expected {size}")
    return data


def open_file(path: Path) -> BufferedReader:
    """A regular file, and no pipe that would never end; in a mirror, fetched before. Raises
    BrokenError, and StoreError."""
    fault = f"{path.name}: is missing, or no file that can be read, though it is listed"
    with raised_as(lambda _: BrokenError(fault), of=(FileNotFoundError, DatasetError)):
        fetch(path)
        return open_bounded(path, sys.maxsize)


def check_sum(file: BufferedReader, name: str, sha256: str) -> None:
    """Raise BrokenError unless the file called `name` has the SHA-256 that the manifest lists."""
    if sha256_in(file) != sha256:
        raise BrokenError(f"{name}: is not the file that the manifest lists")


def open_shard(file: BufferedReader, path: Path, samples: int, layout: Layout) -> ShardFile:
    """The shard in `file`, which `path` was opened as, its layout checked; the file is closed once
    nobody holds the shard any more. Raises BrokenError with what is wrong."""
    try:
        shard = _checked(file, path.name, samples, layout)
    except BaseException:
        file.close()
        raise
    weakref.finalize(shard, file.close)
    return shard


def _checked(file: BufferedReader, name: str, samples: int, layout: Layout) -> ShardFile:
    """The shard in `file`, which errors call `name`."""
    size, most = size_of(file), most_bytes(layout, samples)
    if size > most:
        raise BrokenError(f"{name}: {size} bytes, {samples} samples take {most} at most")
    with raised_as(BrokenError, f"{name}: is damaged: ", of=Hdf5Error):
        index = read_index(file, samples)
    if odd := sorted(set(index.objects) ^ set(layout)):
        named = ", ".join(short(one)[1:-1] for one in odd)
        raise BrokenError(f"{name}: {named}: there or missing, expected just {', '.join(layout)}")
    columns = {}
    for field, (dtype, shape) in layout.items():
        stored = columns[field] = index.objects[field]
        if stored.dtype != dtype or stored.shape != (samples, *shape):
            raise BrokenError(
                f"{name}: {field} is {stored.dtype} {stored.shape[:4]}, expected {dtype} "
                f"{(samples, *shape)}: as many samples as the manifest lists, of the grid's or the "
                "sensor's shape"
            )
        _check_chunks(stored, size, f"{name}: {field}")
    return ShardFile(file, name, columns, index.attributes)


def _check_chunks(stored: Stored, size: int, where: str) -> None:
    """Raise BrokenError unless each sample has a chunk that can be its own, of a file of `size`
    bytes."""
    samples, *shape = stored.shape
    if stored.chunk != (1, *shape):
        raise BrokenError(f"{where} has other chunks than one a sample, {(1, *shape)}")
    odd = set(stored.filters) - FILTERS
    if odd or len(set(stored.filters)) < len(stored.filters):
        raise BrokenError(
            f"{where} has filters {stored.filters}, expected only gzip (1), shuffle (2) and "
            f"fletcher32 (3)"
        )
    places = stored.places
    if not np.array_equal(places[:, 0], np.arange(samples)):
        raise BrokenError(
            f"{where}: {len(np.unique(places[:, 0]))} of {samples} samples are stored, or in "
            "another order"
        )
    most = stored.row_bytes + stored.row_bytes // 100 + 1000
    wrong = (places[:, 1:3] < 0).any(axis=1) | (
        places[:, 2] > np.minimum(most, size - places[:, 1])
    )
    if wrong.any():
        row, begin, length, _ = places[wrong][0].tolist()
        raise BrokenError(
            f"{where}: sample {row}: {length} bytes at byte {begin} cannot be its own"
        )
