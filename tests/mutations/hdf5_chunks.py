"""Damage to a shard's chunks: written past HDF5, with contents, masks and filters of our own."""

import struct
import zlib

import h5py
import numpy as np

from tests.mutations.case import REFUSED, SAME, VALID

BLOCK = 1 << 20


def deflated(size_mb):
    """Raw deflate of so many megabytes of zeros."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    # stands on its own: may be repeated
    block = packer.compress(bytes(BLOCK)) + packer.flush(zlib.Z_FULL_FLUSH)
    return block * size_mb + packer.flush()


def zlibbed(size_mb):
    """The same as a zlib stream; of zeros, Adler-32 counts the length alone."""
    checksum = (size_mb * BLOCK % 65521) << 16 | 1
    return b"\x78\xda" + deflated(size_mb) + struct.pack(">L", checksum)


def taken(file, name):
    """A dataset's values, which are no longer in the file."""
    values = file[name][()]
    del file[name]
    return values


def unknown_filter(file, name, random):
    values = file[name][()]
    made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    made.set_chunk((1, *values.shape[1:]))
    number = random.choice((4, 5, 6, 307, 32000, 32015, 65000))
    flag = random.choice((h5py.h5z.FLAG_OPTIONAL, h5py.h5z.FLAG_OPTIONAL, h5py.h5z.FLAG_MANDATORY))
    try:
        made.set_filter(number, flag, tuple(range(4)))
        kind = h5py.h5t.py_create(values.dtype, logical=True)
        space = h5py.h5s.create_simple(values.shape)
        del file[name]
        made = h5py.h5d.create(file.id, name.encode(), kind, space, made)
        for row in range(len(values)):
            made.write_direct_chunk((row,) + (0,) * (values.ndim - 1), random.randbytes(64), 0)
    except (ValueError, OSError):
        if name not in file:
            file[name] = values
        return f"filter {number}, which HDF5 would not write", VALID
    return f"filter {number}, {'optional' if flag else 'mandatory'}", REFUSED


def chunk_missing(file, name, random):
    values = taken(file, name)
    how = {"chunks": (1, *values.shape[1:]), "compression": "gzip"}
    fill = random.choice((None, 1))
    made = file.create_dataset(name, values.shape, values.dtype, fillvalue=fill, **how)
    for row in range(1, len(values)):
        made[row] = values[row]
    return "first chunk never written", REFUSED


def chunk_of_our_own(file, name, random):
    """Chunks written past HDF5, with masks and contents of our own."""
    data = file[name]
    raw = data[0].tobytes()
    packed, twos = zlib.compress(raw), REFUSED if data.dtype == np.bool_ else VALID
    if data.compression != "gzip":
        return chunk_missing(file, name, random)
    content, mask, said, expected = random.choice(
        (
            (raw[: len(raw) // 2], 1, "unpacked, half as long", REFUSED),
            (raw * 2, 1, "unpacked, twice as long", REFUSED),
            (raw, 1, "unpacked", SAME),
            (packed, 1, "packed, and marked unpacked", REFUSED),
            (raw, 0, "unpacked, and marked packed", REFUSED),
            (zlibbed(40), 0, "of 40 MB", REFUSED),
            (zlib.compress(raw + b"\0"), 0, "one byte too long", REFUSED),
            (packed[: len(packed) // 2], 0, "cut", REFUSED),
            (packed[:-4] + b"\0\0\0\1", 0, "with another checksum", REFUSED),
            (zlib.compress(bytes([2]) * len(raw)), 0, "of twos", twos),
            (packed, 0xFFFFFFFF, "with every filter masked", REFUSED),
        )
    )
    data.id.write_direct_chunk((0,) * data.ndim, content, mask)
    return f"first chunk {said}", expected


def shuffled_bomb(file, name, random):
    old = taken(file, name)
    how = {"chunks": (1, *old.shape[1:]), "compression": "gzip", "shuffle": True}
    made = file.create_dataset(name, old.shape, old.dtype, **how)
    content = zlibbed(random.choice((1, 1, 200, 1024)))
    made.id.write_direct_chunk((0,) * old.ndim, content, 0)
    return f"shuffled chunk of {len(content)} bytes that unpacks to far more", REFUSED
