"""HDF5 files of shards: checked when opened, then read chunk by chunk within limits. Reading,
resuming, verifying and training all use this.

HDF5 may hang, crash or exhaust memory on a crafted file. `verify` opens shards in a process with
limits; all other code reads the user's own files, or files that passed `verify`.
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

from lidarsim.parameters import short_repr
from scenegen.base.errors import CorruptFileError, DatasetError, reraise_as
from scenegen.base.mirrors import fetch
from scenegen.base.reading import open_bounded, sha256_in, size_of
from scenegen.draw.sample import DERIVED, FIELDS, Sample, Schema

DIGEST = "sha256"
"""Name of the HDF5 dataset of the samples' digests, uint8 (N, 32)."""
ATTRIBUTES = ("split", "first_world", "worlds_sha256", "parameters", "rejected")
"""Attributes of a shard's file."""
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
"""Errors that reading a damaged file may raise: h5py translates those of the library to many types.
"""

Layout = Mapping[str, tuple[np.dtype, tuple[int, ...]]]
"""HDF5 datasets of a shard by name: type, and shape of one sample."""


def layout_of(fields: Iterable[str], schema: Schema) -> Layout:
    """Layout of a shard.

    Args:
        fields: Names of the stored fields.
        schema: Schema of the samples.
    """
    columns = {name: (np.dtype(FIELDS[name]["dtype"]), schema.shape(name)) for name in fields}
    return {**columns, DIGEST: (np.dtype(np.uint8), (32,))}


def max_bytes(layout: Layout, samples: int) -> int:
    """Maximum size of a shard's file, bytes, if nothing in it compresses.

    Args:
        layout: Layout of the shard.
        samples: Number of samples.
    """
    # 2000 bytes are ample for the header and index entry of a chunk
    sample_bytes = sum(dtype.itemsize * math.prod(shape) + 2000 for dtype, shape in layout.values())
    return samples * (sample_bytes + sample_bytes // 100) + (1 << 20)


class Rejected(msgspec.Struct):
    """Attribute `rejected` of a shard: numbers of rejected draws by reason."""

    worlds: dict[str, Annotated[int, msgspec.Meta(ge=0)]]
    viewpoints: dict[str, Annotated[int, msgspec.Meta(ge=0)]]


class Chunks:
    """Chunks of an HDF5 dataset, read in their stored form.

    Filters are undone here, as HDF5's own are slower, and accept output of any length.

    Args:
        dataset: The HDF5 dataset.

    Raises:
        ValueError: if it is not stored in chunks in its file, or uses filters other than `FILTERS`.
    """

    def __init__(self, dataset: h5py.h5d.DatasetID):
        plan = dataset.get_create_plist()
        # other layouts may refer to external files
        if plan.get_layout() != h5py.h5d.CHUNKED:
            raise ValueError("is not stored in chunks")
        self.filters = tuple(plan.get_filter(n)[0] for n in range(plan.get_nfilters()))
        """HDF5's numbers of its filters, in the order of writing."""
        if not set(self.filters) <= FILTERS or len(set(self.filters)) < len(self.filters):
            raise ValueError(
                f"has filters {self.filters}, expected only gzip (1), shuffle (2) and "
                "fletcher32 (3)"
            )
        self.dataset, self.dtype, self.shape = dataset, dataset.dtype, dataset.shape
        self.chunk: tuple[int, ...] = plan.get_chunk()
        """Shape of a chunk."""
        self.bytes = self.dtype.itemsize * math.prod(self.chunk)
        """Unpacked size of a chunk."""

    def read(self, offset: tuple[int, ...]) -> bytes:
        """Read the chunk whose first element is at `offset`.

        Raises:
            ValueError: if it does not unpack to the expected size; or another of `READ_ERRORS`.
        """
        skipped_filters, data = self.dataset.read_direct_chunk(offset)
        # deflate never grows data by more than this
        if len(data) > self.bytes + self.bytes // 100 + 1000:
            raise ValueError(f"{len(data)} bytes are stored for {self.bytes}")
        for position in reversed(range(len(self.filters))):  # undo the last filter first
            # HDF5 marks by bits the filters that were skipped for a chunk
            if skipped_filters >> position & 1:
                continue
            number = self.filters[position]
            if number == FLETCHER32:
                data = data[:-4]  # the checksum is ignored: samples have stronger digests
            elif number == SHUFFLE:
                data = np.frombuffer(data, np.uint8).reshape(self.dtype.itemsize, -1).T.tobytes()
            elif number == DEFLATE:
                decompressor = isal.isal_zlib.decompressobj()
                # a limit on the output: a small chunk could unpack to gigabytes
                # 8 bytes to spare: output that is too long must be seen, and not be cut to fit
                data = decompressor.decompress(data, self.bytes + 8)
                if not decompressor.eof:
                    raise ValueError("more or fewer bytes than it should")
        if len(data) != self.bytes:
            raise ValueError(f"{len(data)} bytes, expected {self.bytes}")
        return data


@dataclass(frozen=True, eq=False)
class ShardFile:
    """An open shard with a valid layout. Any number of threads may read it; a forked process must
    open it again. The file is closed when the last reference is gone."""

    file: h5py.File
    name: str
    columns: Mapping[str, Chunks]
    """The file's HDF5 datasets by name, with one chunk for each sample."""
    attributes: Mapping[str, int | str | None]
    """`ATTRIBUTES`; None for one that is missing, or neither an integer nor text."""

    def value(self, name: str, row: int, *, read_only: bool = False) -> Any:
        """Read a field of one sample.

        Args:
            name: The field.
            row: Number of the sample in the shard.
            read_only: Whether the array may be read-only, which saves a copy. Kernels are compiled
                for writable arrays.

        Returns:
            An array, or a scalar.

        Raises:
            CorruptFileError: if the chunk cannot be unpacked, or a flag is neither 0 nor 1.
        """
        column, where = self.columns[name], f"{self.name}: sample {row}: {name}"
        with reraise_as(CorruptFileError, f"{where} cannot be unpacked: ", of=READ_ERRORS):
            raw = column.read((row,) + (0,) * (len(column.shape) - 1))
        is_bool = column.dtype == np.bool_
        values = np.frombuffer(
            raw if read_only else bytearray(raw), np.uint8 if is_bool else column.dtype
        )
        # numpy's results are undefined for other bytes in a bool array
        if is_bool and values.max(initial=0) > 1:
            raise CorruptFileError(f"{where} holds bytes other than 0 and 1")
        # a single value is a number, and no array
        return values.view(column.dtype).reshape(column.shape[1:])[()]

    def column(self, name: str) -> np.ndarray:
        """Read a field of all samples, (N, ...). Raises CorruptFileError."""
        rows = range(self.columns[name].shape[0])
        return np.stack([self.value(name, row, read_only=True) for row in rows])

    def check(self, row: int) -> None:
        """Compare a sample with its stored digest. Derived fields are not covered.

        Args:
            row: Number of the sample in the shard.

        Raises:
            CorruptFileError: if they differ.
        """
        placeholders: dict[str, Any] = {
            name: np.empty(0, FIELDS[name]["dtype"]) for name in DERIVED
        }
        stored = [name for name in self.columns if name not in (DIGEST, *DERIVED)]
        values = {name: self.value(name, row, read_only=True) for name in stored}
        sample = Sample(**placeholders, **values)
        if sample.sha256() != self.value(DIGEST, row).tobytes():
            raise CorruptFileError(
                f"{self.name}: sample {row}: its content does not have the digest stored beside it"
            )

    @property
    def stray_bytes(self) -> int:
        """Bytes of the file beyond its chunks and the overhead of the format (an index entry for
        each chunk, and some kilobytes)."""
        stored = sum(column.dataset.get_storage_size() for column in self.columns.values())
        entries = sum(column.shape[0] for column in self.columns.values())
        return max(self.file.id.get_filesize() - stored - 200 * entries - (1 << 20), 0)

    def check_origin(self, **expected: int | str) -> None:
        """Compare attributes with the manifest.

        Args:
            expected: Expected values by the attribute's name.

        Raises:
            CorruptFileError: if one differs.
        """
        for name, value in expected.items():
            if self.attributes[name] != value:
                raise CorruptFileError(
                    f"{self.name}: was written with {name} {short_repr(self.attributes[name])}, "
                    f"the manifest's is "
                    f"{value!r}: one of the two was edited, or the shard is another dataset's"
                )

    def rejected(self) -> dict[str, Counter[str]]:
        """Numbers of rejected draws by reason, of worlds and of viewpoints. Raises
        CorruptFileError."""
        text = self.attributes["rejected"]
        fault = f"{self.name}: attribute rejected = {short_repr(text)}: expected counts as JSON"
        errors = (ValueError, TypeError, RecursionError)  # msgspec's are ValueErrors
        with reraise_as(lambda _: CorruptFileError(fault), of=errors):
            counts = msgspec.json.decode(str(text), type=Rejected)
        return {"worlds": Counter(counts.worlds), "viewpoints": Counter(counts.viewpoints)}


def open_file(path: Path) -> BufferedReader:
    """Open a regular file; in a mirror, it is fetched first.

    Raises:
        CorruptFileError: if it is missing or cannot be read.
        StoreError: if it cannot be fetched.
    """
    fault = f"{path.name}: is missing, or no file that can be read, though it is listed"
    with reraise_as(lambda _: CorruptFileError(fault), of=(FileNotFoundError, DatasetError)):
        fetch(path)
        return open_bounded(path, sys.maxsize)


def check_sum(file: BufferedReader, name: str, sha256: str) -> None:
    """Compare a file with the manifest.

    Args:
        file: The open file.
        name: Its name, for messages.
        sha256: The SHA-256 in the manifest.

    Raises:
        CorruptFileError: if they differ.
    """
    if sha256_in(file) != sha256:
        raise CorruptFileError(f"{name}: is not the file that the manifest lists")


def open_shard(path: Path, samples: int, layout: Layout) -> ShardFile:
    """Open a shard for reading.

    Args:
        path: A local file.
        samples: Expected number of samples.
        layout: Expected HDF5 datasets; others are refused.

    Raises:
        CorruptFileError: if the file is missing, damaged, or has another layout.
    """
    with open_file(path) as file:
        size, limit = size_of(file), max_bytes(layout, samples)
    if size > limit:
        raise CorruptFileError(f"{path.name}: {size} bytes, {samples} samples take {limit} at most")
    # the size is checked first, so that HDF5 never opens a file of unexpected size
    with reraise_as(CorruptFileError, f"{path.name}: is damaged: ", of=READ_ERRORS):
        # HDF5's cache of chunks, which `Chunks` reads past, would take 0.7 MB a shard
        opened = h5py.File(path, "r", rdcc_nbytes=0, rdcc_nslots=1)
        try:
            return _checked(opened, path.name, samples, layout)
        # also when the run is stopped: HDF5 would keep the file open
        except BaseException:
            opened.close()
            raise


def _checked(file: h5py.File, name: str, samples: int, layout: Layout) -> ShardFile:
    """Check the layout of an open file. `name` is its name in messages."""
    if unexpected := sorted(set(file) ^ set(layout)):
        listed = ", ".join(short_repr(field)[1:-1] for field in unexpected)
        raise CorruptFileError(
            f"{name}: {listed}: there or missing, expected just {', '.join(layout)}"
        )
    columns = {}
    for field, (dtype, shape) in layout.items():
        where = f"{name}: {field}"
        with reraise_as(CorruptFileError, f"{where} ", of=READ_ERRORS):
            column = columns[field] = Chunks(_dataset(file, field))
        if column.dtype != dtype or column.shape != (samples, *shape):
            raise CorruptFileError(
                f"{where} is {column.dtype} {column.shape[:4]}, expected {dtype} "
                f"{(samples, *shape)}: as many samples as the manifest lists, of the grid's or the "
                "sensor's shape"
            )
        # other chunks could make reading one sample unpack the whole file
        if column.chunk != (1, *shape):
            raise CorruptFileError(f"{where} has other chunks than one a sample, {(1, *shape)}")
        if (stored := column.dataset.get_num_chunks()) != samples:
            raise CorruptFileError(f"{where}: {stored} of {samples} samples are stored")
    attributes = {attribute: _attribute(file.attrs, attribute) for attribute in ATTRIBUTES}
    return ShardFile(file, name, columns, attributes)


def _dataset(file: h5py.File, name: str) -> h5py.h5d.DatasetID:
    """Open an HDF5 dataset. Raises ValueError if the name is a link or another object."""
    # checked before the object is opened: an external link could name any file of this machine
    if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        raise ValueError("is a link to elsewhere; only data of its own may be in a shard")
    dataset = h5py.h5o.open(file.id, name.encode())
    if not isinstance(dataset, h5py.h5d.DatasetID):
        raise ValueError("is not a dataset")
    return dataset


def _attribute(attributes: h5py.AttributeManager, name: str) -> int | str | None:
    # scalars only: anything else counts as missing, which `check_origin` reports
    if name not in attributes or attributes.get_id(name).shape != ():
        return None
    value = attributes[name]
    if isinstance(value, np.integer):
        return int(value)
    text = value.decode() if isinstance(value, bytes) else value
    return text if isinstance(text, str) else None
