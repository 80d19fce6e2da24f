"""Files: read only where they are regular and no larger than expected, written whole or not at all."""

import errno
import os
import shutil
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from scenegen.errors import DatasetError

STALE_S = 24 * 3600.0
"""Age after which a temporary file of an unknown machine counts as left behind, seconds."""


def open_bounded(path: Path, most_bytes: int) -> BufferedReader:
    """`path` opened for reading, if it is a regular file of at most `most_bytes` bytes: no pipe or device, whose
    reading might never end.

    Raises DatasetError for anything else, FileNotFoundError where there is nothing.
    """
    try:
        handle = os.open(
            path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK
        )  # opening a pipe does not wait for its writer
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(errno.ENOENT, "no such file", str(path)) from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be opened ({error.strerror}); give a file that can be read") from None
    status = os.fstat(handle)
    if stat.S_ISREG(status.st_mode) and status.st_size <= most_bytes:
        return open(handle, "rb")
    os.close(handle)
    if not stat.S_ISREG(status.st_mode):
        raise DatasetError(f"{path}: is not a regular file; give a file")
    raise DatasetError(f"{path}: {status.st_size} bytes, expected {most_bytes} at most; give a smaller file")


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """The content of a regular file of at most `most_bytes` bytes, however it grows meanwhile. Raises as
    `open_bounded`."""
    with open_bounded(path, most_bytes) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise DatasetError(f"{path}: more than {most_bytes} bytes; give a smaller file")
    return content


def write_whole(path: Path, content: bytes) -> None:
    """Put `content` at `path`: complete and on disk, or not at all. Raises DatasetError where the disk refuses."""
    with whole(path) as draft, open(draft, "wb") as file:
        file.write(content)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary file to write: when the block ends, it stands at `path`, complete and on disk; if it fails, nowhere.

    Raises DatasetError where the disk refuses.
    """
    draft = path.with_name(f".{path.name}.{socket.gethostname()}-{os.getpid()}.tmp")
    try:
        try:
            yield draft
            with open(draft, "rb") as file:
                os.fsync(file.fileno())
            draft.replace(path)
        except BaseException:
            draft.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)
    except OSError as error:
        raise disk_error(path, error) from None


def sync_folder(folder: Path) -> None:
    """Put a folder's entries on disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def disk_error(path: Path, error: OSError) -> DatasetError:
    """What a user can do about an operating system's refusal."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        advice = "the disk is full: free some space, then give the same command again to go on"
    elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        advice = "no permission to write there: choose another place"
    else:
        advice = f"{error.strerror or error}: choose another place"
    return DatasetError(f"{path}: {advice}")


def remove_drafts(folder: Path) -> None:
    """Delete temporary files and folders whose writer is gone."""
    for draft in folder.glob(".*.tmp"):
        owner = draft.name.removesuffix(".tmp").removesuffix(".former")
        host, _, pid = owner.rpartition(".")[2].rpartition("-")
        if host == socket.gethostname():
            gone = not (pid.isdigit() and _is_alive(int(pid)))
        else:
            gone = time.time() - draft.stat().st_mtime > STALE_S
        if gone and draft.is_dir():
            shutil.rmtree(draft, ignore_errors=True)
        elif gone:
            draft.unlink(missing_ok=True)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
