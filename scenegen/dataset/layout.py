"""A shard's HDF5 file: held against the format when it is opened, then read chunk by chunk, each
into no more bytes than it may have. Reading, resuming, verifying and training all go through here.

HDF5 may hang, crash or take all memory on a file that was made to do so. `verify` opens shards in a
process with limits; everything else reads files that are the user's own, or have passed it.
"""

import math
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Annotated, Any

import h5py
import isal.isal_zlib
import msgspec
import numpy as np

from scenegen.base.errors import BrokenError, DatasetError, raised_as, short
from scenegen.base.files import open_bounded, sha256_in, size_of
from scenegen.base.mirrors import fetch
from scenegen.draw.sample import DERIVED, FIELDS, Sample, Schema

DIGEST = "sha256"
"""Name of the dataset that holds the samples' own digests, uint8 (N, 32)."""
ATTRIBUTES = ("split", "first_world", "worlds_sha256", "parameters", "rejected")
"""What a shard says of itself as a whole."""
FILTERS = {DEFLATE := 1, SHUFFLE := 2, FLETCHER32 := 3}
"""HDF5's numbers of the filters that a shard may use."""
READ_ERRORS = (
    isal.isal_zlib.error,
    EOFError,
    KeyError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What reading a damaged HDF5 file may raise: h5py translates the library's errors to many."""

Layout = Mapping[str, tuple[np.dtype, tuple[int, ...]]]
"""Every dataset that a shard has to hold: its type, and the shape of one sample."""


def layout_of(fields: Iterable[str], schema: Schema) -> Layout:
    """The layout of a shard that stores `fields` of samples of that schema."""
    columns = {name: (np.dtype(FIELDS[name]["dtype"]), schema.shape(name)) for name in fields}
    return {**columns, DIGEST: (np.dtype(np.uint8), (32,))}


def most_bytes(layout: Layout, samples: int) -> int:
    """What a shard of `samples` may take on disk, however badly it is packed."""
    each = sum(dtype.itemsize * math.prod(shape) + 2000 for dtype, shape in layout.values())
    return samples * (each + each // 100) + (1 << 20)


class Rejected(msgspec.Struct):
    """What a shard says of draws that were rejected: counts by reason."""

    worlds: dict[str, Annotated[int, msgspec.Meta(ge=0)]]
    viewpoints: dict[str, Annotated[int, msgspec.Meta(ge=0)]]


class Chunks:
    """The chunks of a dataset in an open HDF5 file, read as they are stored.

    Their filters are undone here: HDF5's own are slower, and take whatever comes out of them for
    the values. Raises ValueError for a dataset that is not stored in chunks of its file, or by
    other filters than `FILTERS`.
    """

    def __init__(self, dataset: h5py.h5d.DatasetID):
        plan = dataset.get_create_plist()
        if plan.get_layout() != h5py.h5d.CHUNKED:  # but by other files, for example
            raise ValueError("is not stored in chunks")
        self.filters = tuple(plan.get_filter(n)[0] for n in range(plan.get_nfilters()))
        """HDF5's numbers of them, in the order of writing."""
        if not set(self.filters) <= FILTERS or len(set(self.filters)) < len(self.filters):
            raise ValueError(
                f"has filters {self.filters}, expected only gzip (1), shuffle (2) and "
                "fletcher32 (3)"
            )
        self.dataset, self.dtype, self.shape = dataset, dataset.dtype, dataset.shape
        self.chunk: tuple[int, ...] = plan.get_chunk()
        """Shape of one."""
        self.bytes = self.dtype.itemsize * math.prod(self.chunk)
        """Of one, unpacked."""

    def read(self, offset: tuple[int, ...]) -> bytes:
        """The bytes of the chunk whose first element is at `offset`. Raises one of `READ_ERRORS`
        unless as many come out as there must."""
        left_out, data = self.dataset.read_direct_chunk(offset)
        if len(data) > self.bytes + self.bytes // 100 + 1000:
            raise ValueError(f"{len(data)} bytes are stored for {self.bytes}")
        for place in reversed(range(len(self.filters))):  # the last one first
            if left_out >> place & 1:
                continue
            number = self.filters[place]
            if number == FLETCHER32:
                data = data[:-4]  # its checksum is not looked at: samples' digests are better ones
            elif number == SHUFFLE:
                data = np.frombuffer(data, np.uint8).reshape(self.dtype.itemsize, -1).T.tobytes()
            elif number == DEFLATE:
                unpacking = isal.isal_zlib.decompressobj()
                data = unpacking.decompress(data, self.bytes + 8)
                if not unpacking.eof:
                    raise ValueError("more or fewer bytes than it should")
        if len(data) != self.bytes:
            raise ValueError(f"{len(data)} bytes, expected {self.bytes}")
        return data


@dataclass(frozen=True, eq=False)
class ShardFile:
    """An open shard whose layout is as the format says. Any number of threads may read from it; a
    process that is forked opens its own. Its file is closed once nobody holds it any more."""

    file: h5py.File
    name: str
    columns: Mapping[str, Chunks]
    """The file's HDF5 datasets by name: N chunks each, one a sample."""
    attributes: Mapping[str, int | str | None]
    """`ATTRIBUTES`; None for one that is missing, or neither a whole number nor a text."""

    def value(self, name: str, row: int, *, read_only: bool = False) -> Any:
        """A sample's field. `read_only` saves a copy, but kernels are compiled for arrays that can
        be written.

        Raises BrokenError for a chunk that does not unpack to just what it should.
        """
        column, where = self.columns[name], f"{self.name}: sample {row}: {name}"
        with raised_as(BrokenError, f"{where} cannot be unpacked: ", of=READ_ERRORS):
            raw = column.read((row,) + (0,) * (len(column.shape) - 1))
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
        rows = range(self.columns[name].shape[0])
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
        stored = sum(column.dataset.get_storage_size() for column in self.columns.values())
        entries = sum(column.shape[0] for column in self.columns.values())
        return max(self.file.id.get_filesize() - stored - 200 * entries - (1 << 20), 0)

    def check_origin(self, **expected: int | str) -> None:
        """Raise BrokenError where an attribute of the shard is not as `expected`."""
        for name, value in expected.items():
            if self.attributes[name] != value:
                raise BrokenError(
                    f"{self.name}: was written with {name} {short(self.attributes[name])}, "
                    f"the manifest's is "
                    f"{value!r}: one of the two was edited, or the shard is another dataset's"
                )

    def rejected(self) -> dict[str, Counter[str]]:
        """Rejections by reason, of worlds and of viewpoints. Raises BrokenError."""
        text = self.attributes["rejected"]
        fault = f"{self.name}: attribute rejected = {short(text)}: expected counts as JSON"
        failed = (ValueError, TypeError, RecursionError)  # msgspec's are ValueErrors
        with raised_as(lambda _: BrokenError(fault), of=failed):
            counts = msgspec.json.decode(str(text), type=Rejected)
        return {"worlds": Counter(counts.worlds), "viewpoints": Counter(counts.viewpoints)}


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


def open_shard(path: Path, samples: int, layout: Layout) -> ShardFile:
    """The shard at `path`, opened for reading.

    Args:
        path: A file of this machine.
        samples: How many samples it has to hold.
        layout: The datasets that it has to hold, and no others.

    Raises:
        BrokenError: The file is missing, damaged, or laid out in another way.
    """
    with open_file(path) as file:
        size, limit = size_of(file), most_bytes(layout, samples)
    if size > limit:
        raise BrokenError(f"{path.name}: {size} bytes, {samples} samples take {limit} at most")
    with raised_as(BrokenError, f"{path.name}: is damaged: ", of=READ_ERRORS):
        # HDF5's cache of chunks, which `Chunks` reads past, would take 0.7 MB a shard
        opened = h5py.File(path, "r", rdcc_nbytes=0, rdcc_nslots=1)
        try:
            return _checked(opened, path.name, samples, layout)
        except BaseException:
            opened.close()
            raise


def _checked(file: h5py.File, name: str, samples: int, layout: Layout) -> ShardFile:
    """The shard in `file`, which errors call `name`."""
    if odd := sorted(set(file) ^ set(layout)):
        named = ", ".join(short(field)[1:-1] for field in odd)
        raise BrokenError(f"{name}: {named}: there or missing, expected just {', '.join(layout)}")
    columns = {}
    for field, (dtype, shape) in layout.items():
        where = f"{name}: {field}"
        with raised_as(BrokenError, f"{where} ", of=READ_ERRORS):
            column = columns[field] = Chunks(_dataset(file, field))
        if column.dtype != dtype or column.shape != (samples, *shape):
            raise BrokenError(
                f"{where} is {column.dtype} {column.shape[:4]}, expected {dtype} "
                f"{(samples, *shape)}: as many samples as the manifest lists, of the grid's or the "
                "sensor's shape"
            )
        if column.chunk != (1, *shape):
            raise BrokenError(f"{where} has other chunks than one a sample, {(1, *shape)}")
        if (stored := column.dataset.get_num_chunks()) != samples:
            raise BrokenError(f"{where}: {stored} of {samples} samples are stored")
    attributes = {attribute: _attribute(file.attrs, attribute) for attribute in ATTRIBUTES}
    return ShardFile(file, name, columns, attributes)


def _dataset(file: h5py.File, name: str) -> h5py.h5d.DatasetID:
    """The dataset called `name`. Raises ValueError where that is something else."""
    if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        raise ValueError("is a link to elsewhere; only data of its own may be in a shard")
    dataset = h5py.h5o.open(file.id, name.encode())
    if not isinstance(dataset, h5py.h5d.DatasetID):
        raise ValueError("is not a dataset")
    return dataset


def _attribute(attributes: h5py.AttributeManager, name: str) -> int | str | None:
    if name not in attributes or attributes.get_id(name).shape != ():
        return None
    value = attributes[name]
    if isinstance(value, np.integer):
        return int(value)
    text = value.decode() if isinstance(value, bytes) else value
    return text if isinstance(text, str) else None
