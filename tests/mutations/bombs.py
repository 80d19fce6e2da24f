"""A little that unpacks to very much, made without packing that much."""

import struct
import zlib

BLOCK = 1 << 20


def deflated(size_mb):
    """Raw deflate of so many megabytes of zeros."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(BLOCK)) + packer.flush(
        zlib.Z_FULL_FLUSH
    )  # stands on its own: may be repeated
    return block * size_mb + packer.flush()


def zlibbed(size_mb):
    """The same as a zlib stream; of zeros, Adler-32 counts the length alone."""
    checksum = (size_mb * BLOCK % 65521) << 16 | 1
    return b"\x78\xda" + deflated(size_mb) + struct.pack(">L", checksum)
