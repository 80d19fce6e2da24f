"""A shard's HDF5 file, held against the format object by object before any data is read, and read without HDF5.

HDF5 is asked only where things lie. Chunks are read and unpacked here, each into no more bytes than it may have, so
that neither a decompression bomb nor an external file gets anywhere.
"""

import json
import math
import os
from collections import Counter
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import Any

import h5py
import isal.isal_zlib
import numpy as np
from numpy.typing import NDArray

from scenegen.dataset.shard import DIGEST
from scenegen.dataset.trust import Entry
from scenegen.sample import SCHEMA, shape_of
from scenegen.verify.contract import Contract
from scenegen.verify.report import BrokenError

DEFLATE, SHUFFLE, FLETCHER32 = 1, 2, 3
"""HDF5's numbers of the filters that a shard may use."""


@dataclass(frozen=True, eq=False)
class Column:
    """One dataset of a shard: N chunks, one a sample."""

    name: str
    dtype: np.dtype
    shape: tuple[int, ...]
    """Of one sample."""
    filters: tuple[int, ...]
    """In the order of writing."""
    chunks: tuple[tuple[int, int, int], ...]
    """For every sample: where its chunk begins in the file, bytes, and which filters were left out (a bit each)."""

    @property
    def bytes(self) -> int:
        """Of one sample, unpacked."""
        return int(self.dtype.itemsize * math.prod(self.shape))


@dataclass(frozen=True, eq=False)
class ShardFile:
    """An open shard whose layout is as the format says."""

    file: BufferedReader
    name: str
    columns: dict[str, Column]
    attributes: dict[str, Any]
    _read: dict[str, NDArray[Any]] = field(default_factory=dict)
    """Whole columns, as far as they have been read."""

    def value(self, name: str, row: int, *, read_only: bool = False) -> NDArray[Any]:
        """A sample's field. `read_only` saves a copy, but kernels are compiled for arrays that can be written.

        Raises BrokenError for a chunk that does not unpack to just what it should.
        """
        column = self.columns[name]
        if not column.filters:
            return self._plain(column)[row]
        begin, size, left_out = column.chunks[row]
        packed = os.pread(self.file.fileno(), size, begin)
        try:
            raw = _unpack(packed, column, left_out)
        except (isal.isal_zlib.error, EOFError, ValueError) as error:
            raise BrokenError(f"{self.name}: sample {row}: {name} cannot be unpacked ({error})") from None
        return _array(raw if read_only else bytearray(raw), column, column.shape, f"{self.name}: sample {row}")

    def _plain(self, column: Column) -> NDArray[Any]:
        """All samples of a field that no filter has changed; where the chunks lie in a row, they are read as one."""
        if column.name not in self._read:
            size, first = column.bytes, column.chunks[0][0]
            count = len(column.chunks)
            if any(chunk[1] != size for chunk in column.chunks):
                raise BrokenError(f"{self.name}: {column.name}: samples of other sizes than {size} bytes")
            if all(chunk[0] == first + n * size for n, chunk in enumerate(column.chunks)):
                raw = os.pread(self.file.fileno(), count * size, first)
            else:
                raw = b"".join(os.pread(self.file.fileno(), size, chunk[0]) for chunk in column.chunks)
            if len(raw) != count * size:
                raise BrokenError(f"{self.name}: {column.name}: the file ends within it")
            self._read[column.name] = _array(bytearray(raw), column, (count, *column.shape), self.name)
        return self._read[column.name]


def _array(raw: bytes | bytearray, column: Column, shape: tuple[int, ...], where: str) -> NDArray[Any]:
    """Bytes as an array of a column's type."""
    values = np.frombuffer(raw, dtype=np.uint8 if column.dtype == np.bool_ else column.dtype)
    if column.dtype == np.bool_:
        if values.max(initial=0) > 1:
            raise BrokenError(f"{where}: {column.name} holds bytes other than 0 and 1")
        values = values.view(np.bool_)
    return values.reshape(shape)


def _unpack(packed: bytes, column: Column, left_out: int) -> bytes:
    """A chunk's bytes with the filters undone, last first. Raises ValueError unless as many come out as there must."""
    data = packed
    for place in reversed(range(len(column.filters))):
        if left_out >> place & 1:
            continue
        number = column.filters[place]
        if number == FLETCHER32:
            data = data[:-4]  # its checksum is not looked at: the samples' digests are better ones
        elif number == SHUFFLE:
            if len(data) != column.bytes:
                raise ValueError(f"{len(data)} bytes, expected {column.bytes}")
            data = np.frombuffer(data, np.uint8).reshape(column.dtype.itemsize, -1).T.tobytes()
        else:
            most = column.bytes + 8
            unpacking = isal.isal_zlib.decompressobj()
            data = unpacking.decompress(data, most)
            if not unpacking.eof:
                raise ValueError("more or fewer bytes than it should")
    if len(data) != column.bytes:
        raise ValueError(f"{len(data)} bytes, expected {column.bytes}")
    return data


def open_file(path: Path) -> BufferedReader:
    """A regular file, and no pipe that would never end. Raises BrokenError."""
    if not path.is_file():
        raise BrokenError(f"{path.name}: is missing, or no file, though the manifest lists it")
    try:
        return open(path, "rb")
    except OSError as error:
        raise BrokenError(f"{path.name}: cannot be opened ({error.strerror})") from None


def most_bytes(entry: Entry, contract: Contract) -> int:
    """What a shard may take on disk, however badly it is packed."""
    columns = [(SCHEMA[name]["dtype"], shape_of(name, contract.grid, contract.lidar)) for name in contract.fields]
    each = sum(np.dtype(dtype).itemsize * math.prod(shape) + 2000 for dtype, shape in columns)
    return entry.samples * (each + each // 100) + (1 << 20)


def open_shard(file: BufferedReader, entry: Entry, contract: Contract) -> ShardFile:
    """The shard in `file`, its layout checked. Raises BrokenError with what is wrong.

    HDF5 answers damaged structures with exceptions of many kinds; all mean that the file is damaged.
    """
    try:
        with h5py.File(file, "r") as opened:
            return _open(opened, file, entry, contract)
    except BrokenError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise BrokenError(f"{entry.file}: is damaged, HDF5 says: {reason or type(error).__name__}") from None


def _open(opened: h5py.File, file: BufferedReader, entry: Entry, contract: Contract) -> ShardFile:
    expected = {
        name: (np.dtype(SCHEMA[name]["dtype"]), shape_of(name, contract.grid, contract.lidar))
        for name in contract.fields
    }
    expected[DIGEST] = (np.dtype(np.uint8), (32,))
    size, most = os.fstat(file.fileno()).st_size, most_bytes(entry, contract)
    if size > most:
        raise BrokenError(f"{entry.file}: {size} bytes, {entry.samples} samples take {most} at most")
    count = len(opened)
    if count > 2 * len(expected):
        raise BrokenError(f"{entry.file}: holds {count} objects, expected {len(expected)}: {', '.join(expected)}")
    names = list(opened)
    for name in names:
        if opened.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
            raise BrokenError(f"{entry.file}: {name} is a link to elsewhere; only data of its own may be in a shard")
    if sorted(names) != sorted(expected):
        odd = sorted(set(names) ^ set(expected))
        raise BrokenError(f"{entry.file}: {', '.join(odd)}: there or missing, expected just {', '.join(expected)}")
    columns = {name: _column(opened.id, name, dtype, shape, entry, size) for name, (dtype, shape) in expected.items()}
    stored = sum(chunk[1] for column in columns.values() for chunk in column.chunks)
    # the format's own overhead: an index entry a chunk, and some kilobytes
    if size > stored + 200 * len(columns) * entry.samples + (1 << 20):
        raise BrokenError(f"{entry.file}: {size - stored} of its {size} bytes belong to no sample")
    return ShardFile(file, entry.file, columns, _attributes(opened, entry))


def _column(group: Any, name: str, dtype: np.dtype, shape: tuple[int, ...], entry: Entry, size: int) -> Column:
    """The dataset `name`, checked. Raises BrokenError."""
    where = f"{entry.file}: {name}"
    if h5py.h5o.get_info(group, name.encode()).type != h5py.h5o.TYPE_DATASET:
        raise BrokenError(f"{where} is not a dataset")
    dataset = h5py.h5d.open(group, name.encode())
    if dataset.dtype != dtype or dataset.shape != (entry.samples, *shape):
        raise BrokenError(
            f"{where} is {dataset.dtype} {dataset.shape}, expected {dtype} {(entry.samples, *shape)}: as many samples "
            "as the manifest lists, of the grid's or the sensor's shape"
        )
    plan = dataset.get_create_plist()
    if plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count():
        raise BrokenError(f"{where} keeps its data in other files; only data of its own may be in a shard")
    if plan.get_layout() != h5py.h5d.CHUNKED or plan.get_chunk() != (1, *shape):
        raise BrokenError(f"{where} has other chunks than one a sample, {(1, *shape)}")
    filters = tuple(plan.get_filter(n)[0] for n in range(plan.get_nfilters()))
    odd = [number for number in filters if number not in (DEFLATE, SHUFFLE, FLETCHER32)]
    if odd or len(set(filters)) < len(filters):
        raise BrokenError(f"{where} has filters {filters}, expected only gzip (1), shuffle (2) and fletcher32 (3)")
    raw = int(dtype.itemsize * math.prod(shape))
    chunks: list[Any] = []
    dataset.chunk_iter(chunks.append)
    most = raw + raw // 100 + 1000
    found = {chunk.chunk_offset[0]: (chunk.byte_offset, chunk.size, chunk.filter_mask) for chunk in chunks}
    if len(chunks) != entry.samples or len(found) != entry.samples:
        raise BrokenError(f"{where}: {len(found)} of {entry.samples} samples are stored")
    for row, (begin, stored, _) in found.items():
        if stored > most or begin + stored > size:
            raise BrokenError(f"{where}: sample {row}: {stored} bytes at byte {begin} cannot be its own")
    return Column(name, dtype, shape, filters, tuple(found[row] for row in range(entry.samples)))


def _attributes(opened: h5py.File, entry: Entry) -> dict[str, Any]:
    """What the shard says of itself. Raises BrokenError where that is not what the manifest says."""
    expected: dict[str, Any] = {
        "split": entry.split,
        "first_world": entry.first_world,
        "worlds_sha256": entry.worlds_sha256,
    }
    found = {}
    for name in (*expected, "parameters", "rejected"):
        if name not in opened.attrs:
            raise BrokenError(f"{entry.file}: has no attribute {name}")
        attribute = opened.attrs.get_id(name)
        if attribute.shape != ():
            raise BrokenError(f"{entry.file}: attribute {name} is an array, expected one value")
        found[name] = opened.attrs[name]
    for name, value in expected.items():
        if found[name] != value:
            raise BrokenError(
                f"{entry.file}: was written with {name} {str(found[name])[:80]!r}, the manifest's is {value!r}: one of "
                "the two was edited, or the shard is another dataset's"
            )
    return {**found, "rejected": _rejected(found["rejected"], entry)}


def _rejected(text: Any, entry: Entry) -> dict[str, Counter[str]]:
    """Rejections by reason, of worlds and of viewpoints."""
    try:
        given = json.loads(text)
        found = {what: Counter({str(k): int(v) for k, v in given[what].items()}) for what in ("worlds", "viewpoints")}
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        raise BrokenError(f"{entry.file}: attribute rejected = {str(text)[:80]!r}: expected counts as JSON") from None
    return found
