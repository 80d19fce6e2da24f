"""HDF5 as a shard uses it, read without the HDF5 library: on hostile bytes that one hangs, crashes
or takes all memory."""

import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenegen.limits import MOST_BLOCK_BYTES, MOST_BLOCKS, MOST_HEAP_BYTES, MOST_OBJECTS

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


SIGNATURE = b"\x89HDF\r\n\x1a\n"
UNDEFINED = 2**64 - 1
"""The address of what is not there."""


def walk(handle: int, most_chunks: int) -> Index:
    """The index of the open file `handle`, whose datasets have at most `most_chunks` chunks each.

    Raises ForeignError for a file that the HDF5 library may be able to read, Hdf5Error for a
    damaged one.
    """
    try:
        return _Walk(handle, most_chunks).index()
    except Hdf5Error:
        raise
    except (struct.error, IndexError, ValueError, OverflowError, OSError) as error:
        raise Hdf5Error(f"a structure of it cannot be ({error})") from None


class _Walk:
    """One walk through a file."""

    def __init__(self, handle: int, most_chunks: int):
        self._handle, self._most = handle, most_chunks
        self._size = os.fstat(handle).st_size
        self._left = 2 * self._size + 200
        self._seen: set[int] = set()
        self._heaps: dict[int, bytes] = {}

    def _at(self, begin: int, length: int) -> bytes:
        """`length` bytes from `begin`, if the file has them."""
        if begin + length > self._size:
            raise Hdf5Error(f"it ends at byte {self._size}, within a structure at byte {begin}")
        self._left -= length
        if (
            self._left < 0
        ):  # beginnings of structures are read twice, and nothing else in a sound file
            raise Hdf5Error("its structures overlap")
        return os.pread(self._handle, length, begin)

    def _once(self, begin: int) -> None:
        """Nothing in a sound file is pointed at twice; so loops end."""
        if begin in self._seen:
            raise Hdf5Error(f"two pointers lead to byte {begin}")
        self._seen.add(begin)

    def index(self) -> Index:
        head = self._at(0, min(96, self._size))
        if head[:8] != SIGNATURE:
            raise Hdf5Error("it is no HDF5 file")
        if head[8] != 0:
            raise ForeignError(f"its superblock has version {head[8]}")
        offsets, lengths, base, end, driver, root = struct.unpack("<13xBB9xQ8xQQ8xQ24x", head)
        if (offsets, lengths, base, driver) != (8, 8, 0, UNDEFINED):
            raise ForeignError("its superblock is unusual")
        if end > self._size:
            raise Hdf5Error(f"it has {self._size} bytes of {end}")
        found, attributes = self._header(root)
        if SYMBOLS not in found:
            raise ForeignError("its root group has no symbol table")
        if len(attributes) > MOST_OBJECTS:
            raise Hdf5Error(f"it has more than {MOST_OBJECTS} attributes")
        objects: dict[str, Stored | str] = {}
        for name, header, soft in self._names(*struct.unpack_from("<QQ", found[SYMBOLS])):
            objects[name] = LINK if soft else self._dataset(header)
        return Index(objects, dict(map(self._attribute, attributes)))

    def _header(self, address: int) -> tuple[dict[int, bytes], list[bytes]]:
        """An object's messages by their numbers, the first of each kind, and all its attributes."""
        start = self._at(address, 16)
        if start[:4] == b"OHDR":
            raise ForeignError("its object headers have version 2")
        version, length = struct.unpack("<B7xI4x", start)
        if version != 1:
            raise Hdf5Error(f"no object begins at byte {address}")
        found: dict[int, bytes] = {}
        attributes = []
        blocks = [(address + 16, length)]
        for begin, length in blocks:  # which grow meanwhile
            if len(blocks) > MOST_BLOCKS or length > MOST_BLOCK_BYTES:
                raise Hdf5Error(f"the object at byte {address} has too long a header")
            self._once(begin)
            block, place = self._at(begin, length), 0
            while place + 8 <= length:
                kind, size, flags = struct.unpack_from("<HHB", block, place)
                body = block[place + 8 : place + 8 + size]
                place += 8 + size
                if len(body) < size:
                    raise Hdf5Error(f"a message in the block at byte {begin} is longer than that")
                if kind == CONTINUATION:
                    blocks.append(struct.unpack_from("<QQ", body))
                elif kind and flags & 2:
                    raise ForeignError("its headers share messages")
                elif kind == ATTRIBUTE:
                    attributes.append(body)
                else:
                    found.setdefault(kind, body)
        return found, attributes

    def _leaves(self, root: int, kind: int, entry: np.dtype, most: int) -> NDArray[Any]:
        """All entries of the lowest nodes of a version 1 B-tree, in order."""
        nodes, level = [root], None
        while True:
            found, total = [np.empty(0, entry)], 0
            for address in nodes:
                self._once(address)
                mark, what, here, count = struct.unpack("<4sBBH16x", self._at(address, 24))
                if mark != b"TREE" or what != kind or here != (here if level is None else level):
                    raise Hdf5Error(f"no node of a B-tree begins at byte {address}")
                level, total = here, total + count
                if total > min(most, self._size // entry.itemsize):
                    raise Hdf5Error(
                        f"its index lists more than {most} of what is there once a sample"
                    )
                found.append(np.frombuffer(self._at(address + 24, count * entry.itemsize), entry))
            entries = np.concatenate(found)
            if not level:
                return entries
            nodes, level = entries["child"].tolist(), level - 1

    def _names(self, tree: int, heap: int) -> list[tuple[str, int, bool]]:
        """(name, address of the object's header, whether it is a soft link) of all that the root
        group holds."""
        mark, length, _, place = struct.unpack("<4s4xQQQ", self._at(heap, 32))
        if mark != b"HEAP" or length > MOST_HEAP_BYTES:
            raise Hdf5Error(f"no heap of names begins at byte {heap}")
        texts = self._at(place, length)
        entry = np.dtype([("key", "<u8"), ("child", "<u8")])
        found: list[tuple[str, int, bool]] = []
        for node in self._leaves(tree, 0, entry, MOST_OBJECTS)["child"].tolist():
            self._once(node)
            mark, count = struct.unpack("<4s2xH", self._at(node, 8))
            if mark != b"SNOD" or len(found) + count > MOST_OBJECTS:
                raise Hdf5Error(f"no table of at most {MOST_OBJECTS} names begins at byte {node}")
            for name, header, cache in struct.iter_unpack(
                "<QQI20x", self._at(node + 8, 40 * count)
            ):
                found.append((texts[name : texts.index(b"\0", name)].decode(), header, cache == 2))
        if len({name for name, _, _ in found}) < len(found):
            raise Hdf5Error("it holds two objects of one name")
        return found

    def _dataset(self, address: int) -> Stored | str:
        found, _ = self._header(address)
        if not {SPACE, TYPE, LAYOUT} <= set(found):
            return NO_DATASET
        if EXTERNAL in found:
            return ELSEWHERE
        shape, layout, filters = (
            shape_in(found[SPACE]) or (),
            found[LAYOUT],
            filters_in(found.get(FILTERS)),
        )
        if layout[0] != 3:
            raise ForeignError(f"its layouts have version {layout[0]}")
        chunk, places = None, np.empty((0, 4), np.int64)
        if layout[1] == 2:
            tree, *sizes = struct.unpack_from(f"<Q{layout[2]}I", layout, 3)
            chunk = tuple(sizes[:-1])
            if shape and chunk == (1, *shape[1:]) and tree != UNDEFINED:
                places = self._places(tree, len(shape))
        return Stored(type_in(found[TYPE]), shape, chunk, filters, places)

    def _places(self, tree: int, rank: int) -> NDArray[np.int64]:
        entry = np.dtype(
            [("bytes", "<u4"), ("mask", "<u4"), ("first", "<u8", (rank + 1,)), ("child", "<u8")]
        )
        found = self._leaves(tree, 1, entry, self._most)
        begin, length, size = (
            found["child"],
            found["bytes"].astype(np.uint64),
            np.uint64(self._size),
        )
        outside = (begin > size) | (length > size - np.minimum(begin, size))
        if (
            outside.any()
            or found["first"][:, 1:].any()
            or (found["first"][:, 0] >= np.uint64(self._most)).any()
        ):
            raise Hdf5Error("its index names places outside of it")
        return np.stack([found["first"][:, 0], begin, length, found["mask"]], axis=1).astype(
            np.int64
        )

    def _attribute(self, body: bytes) -> tuple[str, int | str | None]:
        version, flags, *sizes = struct.unpack_from("<BBHHH", body)
        if version not in (1, 2, 3) or (version > 1 and flags):
            raise ForeignError(f"an attribute has version {version}")
        place, parts = 8 + (version == 3), []
        for size in sizes:
            parts.append(body[place : place + size])
            place += -(-size // 8) * 8 if version == 1 else size
        name, kind, space = parts[0].rstrip(b"\0").decode(), parts[1], parts[2]
        return name, None if shape_in(space) != () else self._scalar(kind, body[place:])

    def _scalar(self, kind: bytes, data: bytes) -> int | str | None:
        """A whole number or a text; None for anything else."""
        what, bits, size = struct.unpack_from("<BB2xI", kind)
        if what & 15 == 0 and not bits & 1 and size <= 8:
            return int.from_bytes(data[:size], "little", signed=bool(bits & 8))
        if what & 15 == 3:
            return data[:size].split(b"\0")[0].decode()
        if what & 15 == 9 and bits & 15 == 1:
            return self._text(*struct.unpack_from("<IQI", data))
        return None

    def _text(self, length: int, heap: int, number: int) -> str:
        """Object `number` of a global heap."""
        if heap not in self._heaps:
            mark, size = struct.unpack("<4s4xQ", self._at(heap, 16))
            if mark != b"GCOL" or size > MOST_HEAP_BYTES:
                raise Hdf5Error(f"no heap of texts begins at byte {heap}")
            self._heaps[heap] = self._at(heap, size)
        content, place = self._heaps[heap], 16
        while place + 16 <= len(content):
            here, size = struct.unpack_from("<H6xQ", content, place)
            if here == number and number and length <= size:
                return content[place + 16 : place + 16 + length].decode()
            place += 16 + -(-size // 8) * 8 if here else len(content)
        raise Hdf5Error(f"the heap of texts at byte {heap} has no number {number}")
