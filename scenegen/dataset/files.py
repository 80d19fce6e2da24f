"""Files that are whole or absent: written under a temporary name, synced, then renamed."""

import errno
import os
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scenegen.errors import DatasetError

STALE_S = 24 * 3600.0
"""Age after which a temporary file of an unknown machine counts as left behind, seconds."""


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
