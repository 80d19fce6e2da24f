"""Messages in the headers of HDF5 objects, as h5py writes them by default, and what a file is found
to hold."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SPACE, TYPE, EXTERNAL, LAYOUT, FILTERS, ATTRIBUTE, CONTINUATION, SYMBOLS = (
    0x1,
    0x3,
    0x7,
    0x8,
    0xB,
    0xC,
    0x10,
    0x11,
)
"""Numbers of the messages in an object's header."""
LINK, NO_DATASET, ELSEWHERE = (
    "is a link to elsewhere",
    "is not a dataset",
    "keeps its data in other files",
)
"""Why an object of a file holds no data of its own."""


class Hdf5Error(ValueError):
    """A file is no sound HDF5, and why, in one line."""


class ForeignError(Hdf5Error):
    """A file has a structure that h5py does not write by default; it may well be sound."""


@dataclass(frozen=True, eq=False)
class Stored:
    """A dataset, as its file describes it."""

    dtype: np.dtype | None
    """None for a type that no field of a sample has."""
    shape: tuple[int, ...]
    chunk: tuple[int, ...] | None
    """Shape of a chunk; None where the data are not stored in chunks."""
    filters: tuple[int, ...]
    """HDF5's numbers of them, in the order of writing."""
    places: NDArray[np.int64]
    """(n, 4) of the stored chunks, if each is one row: row, first byte in the file, bytes, filters
    left out (bits)."""


@dataclass(frozen=True, eq=False)
class Index:
    """What a file's root group holds."""

    objects: Mapping[str, Stored | str]
    """Every name's dataset, or why there is none."""
    attributes: Mapping[str, int | str | None]
    """Single numbers and texts; None for other values."""


def _whole(size: int, *, signed: bool) -> bytes:
    """The datatype message of a little-endian integer."""
    return struct.pack("<BBxxIHH", 0x10, 8 * signed, size, 0, 8 * size)


TYPES: dict[bytes, np.dtype] = {
    struct.pack("<BBBxIHHBBBBI", 0x11, 0x20, 31, 4, 0, 32, 23, 8, 0, 23, 127): np.dtype("<f4"),
    struct.pack("<BBBxIHHBBBBI", 0x11, 0x20, 63, 8, 0, 64, 52, 11, 0, 52, 1023): np.dtype("<f8"),
    _whole(8, signed=True): np.dtype("<i8"),
    _whole(4, signed=True): np.dtype("<i4"),
    _whole(2, signed=False): np.dtype("<u2"),
    _whole(1, signed=False): np.dtype("u1"),
    # h5py's bool: an enumeration of two names
    struct.pack(
        "<BHxI12s8s8sBB", 0x18, 2, 1, _whole(1, signed=True), b"FALSE", b"TRUE", 0, 1
    ): np.dtype(bool),
}
"""The types of a sample's fields, by their datatype messages."""


def shape_in(space: bytes) -> tuple[int, ...] | None:
    """The extents in a dataspace message; None for one without."""
    version, rank, _, kind = struct.unpack_from("<4B", space)
    if version not in (1, 2):
        raise ForeignError(f"a dataspace has version {version}")
    if version == 2 and kind == 2:
        return None
    return struct.unpack_from(f"<{rank}Q", space, 8 if version == 1 else 4)


def type_in(datatype: bytes) -> np.dtype | None:
    """The type in a datatype message; None for one that no field of a sample has."""
    if datatype[0] >> 4 != 1:
        raise ForeignError(f"a datatype has version {datatype[0] >> 4}")
    return next((known for raw, known in TYPES.items() if datatype.startswith(raw)), None)


def filters_in(pipeline: bytes | None) -> tuple[int, ...]:
    """The numbers in a filter pipeline message."""
    if pipeline is None:
        return ()
    if pipeline[0] != 1:
        raise ForeignError(f"a filter pipeline has version {pipeline[0]}")
    found, place = [], 8
    for _ in range(pipeline[1]):
        number, name, _, values = struct.unpack_from("<4H", pipeline, place)
        found.append(number)
        place += 8 + -(-name // 8) * 8 + 4 * (values + values % 2)
    return tuple(found)
