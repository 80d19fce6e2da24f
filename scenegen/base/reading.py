"""Read files that are regular and small enough; digests of files and of worlds."""

import hashlib
import os
import stat
from collections.abc import Mapping
from io import BufferedReader
from pathlib import Path
from typing import Any

from scenegen.base.errors import DatasetError, NotFoundError


def open_bounded(path: Path, max_bytes: int) -> BufferedReader:
    """Open a regular file for reading. Pipes and devices are refused: reading them might never end.

    Args:
        path: The file.
        max_bytes: Largest allowed size.

    Raises:
        NotFoundError: if there is no file.
        DatasetError: if it is not regular, too large, or cannot be opened.
    """
    try:
        # O_NONBLOCK: opening a pipe must not wait for a writer
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except (FileNotFoundError, NotADirectoryError):
        raise NotFoundError(f"{path}: no such file") from None
    except OSError as error:
        raise DatasetError(
            f"{path}: cannot be opened ({error.strerror}); give a file that can be read"
        ) from None
    # checked on the open handle, as the path may be exchanged meanwhile
    status = os.fstat(handle)
    regular = stat.S_ISREG(status.st_mode)
    if regular and status.st_size <= max_bytes:
        return open(handle, "rb")
    os.close(handle)
    too_large = f"{status.st_size} bytes, expected {max_bytes} at most; give a smaller file"
    raise DatasetError(f"{path}: {too_large if regular else 'is not a regular file; give a file'}")


def pread(file: BufferedReader, size: int, begin: int) -> bytes:
    """Read from an open file without moving its position, as `os.pread`.

    Args:
        file: The open file.
        size: Number of bytes.
        begin: Offset of the first.
    """
    return os.pread(file.fileno(), size, begin)


def size_of(file: BufferedReader) -> int:
    """Size of an open file, bytes."""
    return os.fstat(file.fileno()).st_size


def read_bounded(path: Path, max_bytes: int) -> bytes:
    """Read a regular file that is no larger than `max_bytes`.

    Args:
        path: The file.
        max_bytes: Largest allowed size.

    Raises:
        NotFoundError: if there is no file.
        DatasetError: if it is not regular, too large, grows meanwhile, or cannot be read.
    """
    with open_bounded(path, max_bytes) as file:
        size = size_of(file)
        content = file.read(size + 1)  # its size, not `max_bytes`: `read` takes that much memory
    if len(content) > size:
        raise DatasetError(f"{path}: grows while it is read; wait until it is written")
    return content


def sha256_of(content: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def sha256_in(file: Any) -> str:
    """SHA-256 of an open file's whole content, in hexadecimal."""
    file.seek(0)
    return hashlib.file_digest(file, "sha256").hexdigest()


def world_digest(document: bytes, files: Mapping[str, bytes]) -> bytes:
    """SHA-256 of a world.

    Args:
        document: The MJCF document.
        files: Files that it refers to, by name.

    Returns:
        32 bytes.
    """
    digest = hashlib.sha256(document)
    # sorted: the digest must not depend on the order in which files were read
    for name, content in sorted(files.items()):
        digest.update(name.encode() + hashlib.sha256(content).digest())
    return digest.digest()
