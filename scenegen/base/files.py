"""Files: read only if regular and small enough, written completely or not at all."""

import errno
import json
import os
import re
import secrets
import shutil
import socket
import stat
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

from scenegen.base.errors import DatasetError, DiskError
from scenegen.base.executors import LOCATED, undone
from scenegen.base.limits import MAX_MANIFEST_BYTES
from scenegen.base.reading import read_bounded, sha256_of

PART = re.compile(r"(train|val|test)-[0-9]+x+", re.ASCII)
"""Folders inside a dataset that hold a thousand shards each."""
STALE_S = 24 * 3600.0
"""Age after which another machine's temporary file counts as abandoned, seconds."""
MARK = "user.scenegen"
"""Extended attribute of every file that scenegen writes: its modification time. See `check_ours`.
"""
Json = dict[str, Any]
"""A JSON object as Python values."""
DRAFT = re.compile(r"\.scenegen-(\w{12})-(\w{12})-(\d{1,10})-(\d{1,20})-\w{16}\.tmp", re.ASCII)
"""Names of temporary files: digest of the target's name, machine, process id, start time of the
process, and a secret."""


def real_path(path: Any) -> Path:
    """Resolve links, to compare paths. A store, or a local copy of one, gives the store's name."""
    if not isinstance(path, Path):
        return Path(str(path))
    # `Path.resolve` raises RuntimeError for a circle of links. `os.path.realpath` keeps it, and
    # opening the path then reports that it does not exist.
    return Path(LOCATED[path][1]) if path in LOCATED else Path(os.path.realpath(path))


def check_target(path: Path) -> None:
    """Check that a file may be written at `path`. Devices, pipes, folders and links are never
    replaced.

    Args:
        path: The target.

    Raises:
        DatasetError: if `path` exists and is not a regular file.
    """
    with disk_errors(path), suppress(FileNotFoundError):
        mode = path.lstat().st_mode
        if stat.S_ISREG(mode):
            return
        kind = "a symbolic link" if stat.S_ISLNK(mode) else "not a regular file"
        raise DatasetError(f"{path}: is {kind}, and only files are replaced; give another name")


def writable(folder: Path) -> Path:
    """Find the nearest existing folder at or above `folder`.

    Raises:
        DiskError: if that folder cannot be written.
    """
    existing = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not os.access(existing, os.W_OK):
        raise DiskError(f"{folder}: no permission to write there: choose another place")
    return existing


PARTS_OF_FOLDERS = re.compile(
    r"(dataset|collection|predictions|completions)\.json|rays\.npy|metrics\.csv"
    r"|(train|val|test)-[0-9]+\.(h5|worlds\.zip)"
)
"""Names of files that make a folder a dataset, predictions or a run. No result replaces one, though
scenegen wrote it: the folder would be lost."""


def check_ours(path: Path) -> None:
    """Check that `path` is free, or a result that scenegen wrote and nobody changed since.

    On a file system without extended attributes, no existing file counts as ours.

    Args:
        path: The target.

    Raises:
        DatasetError: if another file stands there.
        DiskError: if its folder cannot be written.
    """
    check_target(path)
    writable(path.parent)
    if path.exists() and PARTS_OF_FOLDERS.fullmatch(path.name):
        raise DatasetError(
            f"{path}: is a file of a dataset, of predictions or of a run; give another name"
        )
    if path.exists() and not _is_marked(path):
        raise DatasetError(
            f"{path}: is there already, and not as scenegen wrote it; remove it, or give another "
            "name"
        )


def _is_marked(path: Path) -> bool:
    try:
        # any edit of the file changes its time, so that it no longer counts as ours
        return int(os.getxattr(path, MARK)) == path.stat().st_mtime_ns
    except (OSError, ValueError):
        return False


def make_parent(path: Path) -> None:
    """Make the folder of `path`. Raises DiskError if the disk refuses."""
    with disk_errors(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)


def make_way(path: Path) -> None:
    """Make the folder of `path`, and delete abandoned temporary files of it."""
    make_parent(path)
    remove_temp_files(path.parent, path.name)


def write_atomic(path: Path, content: bytes, *, sync: bool = True) -> None:
    """Write a file atomically.

    Args:
        path: The target.
        content: The bytes.
        sync: Whether to return only when the content is on disk.

    Raises:
        DatasetError: if `path` is neither free nor a regular file.
        DiskError: if the disk refuses.
    """
    with _draft(path, sync) as file:
        file.write(content)


def write_result(path: Path, content: bytes) -> None:
    """Write a file that a user named.

    Args:
        path: The target.
        content: The bytes.

    Raises:
        DatasetError: if a file stands there that scenegen did not write.
        DiskError: if the disk refuses.
    """
    check_ours(path)
    make_way(path)
    write_atomic(path, content)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Give an empty file to write to. It replaces `path` when the block ends, and is deleted if the
    block fails.

    Args:
        path: The target.

    Yields:
        The temporary file.

    Raises:
        DatasetError: if `path` is neither free nor a regular file.
        DiskError: if the disk refuses.
    """
    with _draft(path) as file:
        yield Path(file.name)


def check_free(path: Path) -> None:
    """Check that nothing exists at `path`, not even a broken link.

    Raises:
        DatasetError: if something does.
    """
    if path.exists() or path.is_symlink():
        raise DatasetError(f"{path}: is there already; give another name, or remove it")


@contextmanager
def whole_folder(path: Path, check: Callable[[Path], None] = check_free) -> Iterator[Path]:
    """Give a folder to write to. It replaces `path` when the block ends; if the block fails,
    nothing changes.

    Args:
        path: The target.
        check: Called before and after the block with `path`. It raises an error if `path` must not
            be replaced.

    Yields:
        The temporary folder.

    Raises:
        DiskError: if the disk refuses. Errors of `check` pass through.
    """
    check(path)
    make_way(path)
    draft, previous = draft_of(path), draft_of(path)

    def clear() -> None:
        # stopped between the two renames below: put the previous folder back
        if previous.exists() and not path.exists():
            previous.rename(path)
        for stale in (draft, previous):
            shutil.rmtree(stale, ignore_errors=True)

    with disk_errors(path), undone(clear):
        draft.mkdir()
        yield draft
        sync_folder(draft)
        # again: somebody may have put something there while the block ran
        check(path)
        if path.exists():
            # rename(2) does not replace a folder that holds files
            path.rename(previous)
        draft.rename(path)
        sync_folder(path.parent)


def claim(folder: Path, name: str, settings: Json) -> Collection[str]:
    """Reserve a folder for a run, or continue a run with the same settings.

    Args:
        folder: The folder. It is made if it does not exist.
        name: File in the folder that records the settings.
        settings: The settings of the run.

    Returns:
        Names of the files that are in the folder.

    Raises:
        DatasetError: if the folder holds other files, or a run with other settings.
    """
    content = json.dumps(settings, indent=1).encode()
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_temp_files(folder)
        # listed first: what another process begins meanwhile, it begins with that file
        names = list_dir(folder)
    state = folder / name
    if begun := state.exists():
        occupied = read_bounded(state, MAX_MANIFEST_BYTES) != content
    else:
        # an ending of .tmp: another job that begins the same run has its draft here
        occupied = any(not item.endswith(".tmp") for item in names)
    if occupied:
        raise DatasetError(
            f"{folder}: holds other files, or what another command began; choose another folder"
        )
    if not begun:
        write_atomic(state, content)
    return names


@contextmanager
def _draft(path: Path, sync: bool = True) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`, which replaces it when the block ends; see `whole`."""
    check_target(path)
    draft = draft_of(path)
    # a file of its own: where somebody else's has this name, it stays
    with (
        disk_errors(path),
        open(draft, "xb") as file,
        undone(lambda: draft.unlink(missing_ok=True)),
    ):
        yield file
        file.flush()
        # after the flush, as the last write changes the time that the mark holds
        status = os.fstat(file.fileno())
        with suppress(OSError):
            # refused by file systems without extended attributes; see `check_ours`
            os.setxattr(file.fileno(), MARK, str(status.st_mtime_ns).encode())
        if sync:
            os.fsync(file.fileno())
        # in a shared folder, another user may have put a file of theirs under the draft's name
        if not os.path.samestat(draft.lstat(), status):
            raise DatasetError(f"{path}: was exchanged while it was written")
        check_target(path)
        draft.replace(path)
        if sync:
            sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Put a folder's entries on disk. Without it, a rename may be lost in a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def disk_errors(path: object) -> Iterator[None]:
    """Raise the operating system's errors in the block as DiskErrors with advice.

    Args:
        path: The file or folder, for the message.

    Raises:
        DiskError: in place of an OSError.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            advice = "the disk is full: free some space, then give the same command again to go on"
        elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            advice = "no permission to write there: choose another place"
        else:
            advice = f"{error.strerror or error}: choose another place"
        raise DiskError(f"{path}: {advice}") from None


def draft_of(path: Path) -> Path:
    """Make an unguessable temporary name beside `path`. It records the target and this process, so
    that `remove_temp_files` can recognise abandoned ones."""
    pid, secret = os.getpid(), secrets.token_hex(8)
    owner = f"{_digest(path.name)}-{_machine()}-{pid}-{_own_start(pid)}-{secret}"
    return path.with_name(f".scenegen-{owner}.tmp")


def list_dir(folder: Path) -> set[str]:
    """List the files of a dataset's folder. Those in subfolders of shards are listed as
    "subfolder/name"."""
    names = {item.name for item in os.scandir(folder)}
    for part in filter(PART.fullmatch, list(names)):
        with suppress(NotADirectoryError):
            within = {f"{part}/{item.name}" for item in os.scandir(folder / part)}
            names = names - {part} | within
    return names


def remove_temp_files(folder: Path, target: str | None = None) -> None:
    """Delete this user's abandoned temporary files in `folder` and in its subfolders of shards.

    A file is abandoned if its process on this machine has ended, or if it was written on another
    machine and not changed for `STALE_S`.

    Args:
        folder: The folder.
        target: Delete only those that were to become this name.
    """
    pattern = ".scenegen-*.tmp"
    for draft in (*folder.glob(pattern), *folder.glob(f"*-*x/{pattern}")):
        match = DRAFT.fullmatch(draft.name)
        if not match or (target and match[1] != _digest(target)):
            continue
        with suppress(OSError):  # another process may be removing it
            status = draft.lstat()
            if status.st_uid != os.geteuid() or not _is_gone(match, status.st_mtime):
                continue
            if stat.S_ISDIR(status.st_mode):
                shutil.rmtree(draft, ignore_errors=True)
            elif stat.S_ISREG(status.st_mode):
                draft.unlink()


def _is_gone(match: re.Match[str], modified_s: float) -> bool:
    """Whether the process that made a temporary file has ended."""
    _, machine, pid, start = match.groups()
    if machine == _machine():
        return _start_of(int(pid)) != int(start)
    # nobody here can ask whether a process of another machine still runs
    return time.time() - modified_s > STALE_S


def _start_of(pid: int) -> int:
    """Start time of a process, in clock ticks since boot; 0 if it does not run."""
    try:
        # from the last parenthesis on: the program's name before it may hold spaces and parentheses
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    # zombies have ended, too; field 22 of `proc(5)` is the start time, which tells a process from a
    # later one with the same id
    return 0 if fields[0] in "ZX" else int(fields[19])


@cache
def _own_start(pid: int) -> int:
    """Start time of this process. Cached, as reading it takes as long as writing a small file."""
    return _start_of(pid)


@cache
def _machine() -> str:
    """Digest of this machine or container: the scope in which a process id is unique."""
    return _digest(f"{socket.gethostname()} {Path('/proc/self/ns/pid').readlink()}")


def _digest(text: str) -> str:
    return sha256_of(os.fsencode(text))[:12]
