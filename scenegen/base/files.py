"""Files: read only where they are regular and no larger than expected, written whole or not at
all.
"""

import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import stat
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

from scenegen.base.errors import AbsentError, DatasetError, DiskError
from scenegen.base.executors import LOCATED, undone
from scenegen.base.limits import MOST_MANIFEST_BYTES

PART = re.compile(r"(train|val|test)-[0-9]+x+", re.ASCII)
"""Names of the folders in a dataset's, of which each holds a thousand shards."""
STALE_S = 24 * 3600.0
"""Age after which a draft of another machine counts as left behind, seconds."""
MARK = "user.scenegen"
"""The attribute of every file written whole, which holds when that was: see `check_ours`."""
Json = dict[str, Any]
"""What a file of JSON holds: values of Python's own types, by name."""
DRAFT = re.compile(r"\.scenegen-(\w{12})-(\w{12})-(\d{1,10})-(\d{1,20})-\w{16}\.tmp", re.ASCII)
"""What drafts are called: for which name, on which machine and by which process, when that began,
and a secret."""


def open_bounded(path: Path, most_bytes: int) -> BufferedReader:
    """`path` opened for reading, if it is a regular file of at most `most_bytes` bytes: no pipe or
    device, whose reading might never end.

    Raises DatasetError for anything else, and AbsentError where there is nothing.
    """
    try:
        handle = os.open(
            path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK
        )  # opening a pipe does not wait for its writer
    except (FileNotFoundError, NotADirectoryError):
        raise AbsentError(f"{path}: no such file") from None
    except OSError as error:
        raise DatasetError(
            f"{path}: cannot be opened ({error.strerror}); give a file that can be read"
        ) from None
    status = os.fstat(handle)
    regular = stat.S_ISREG(status.st_mode)
    if regular and status.st_size <= most_bytes:
        return open(handle, "rb")
    os.close(handle)
    large = f"{status.st_size} bytes, expected {most_bytes} at most; give a smaller file"
    raise DatasetError(f"{path}: {large if regular else 'is not a regular file; give a file'}")


def pread(file: BufferedReader, size: int, begin: int) -> bytes:
    """Bytes of an open file, as `os.pread`."""
    return os.pread(file.fileno(), size, begin)


def size_of(file: BufferedReader) -> int:
    """The bytes of an open file."""
    return os.fstat(file.fileno()).st_size


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """The content of a regular file of at most `most_bytes` bytes. Raises as `open_bounded`, and
    where the file grows meanwhile."""
    with open_bounded(path, most_bytes) as file:
        size = size_of(file)
        content = file.read(size + 1)  # room for its size alone: `most_bytes` may be any number
    if len(content) > size:
        raise DatasetError(f"{path}: grows while it is read; wait until it is written")
    return content


def sha256_of(content: bytes) -> str:
    """The SHA-256 of some bytes, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def sha256_in(file: Any) -> str:
    """The SHA-256 of what an open file holds, in hexadecimal."""
    file.seek(0)
    return hashlib.file_digest(file, "sha256").hexdigest()


def world_digest(document: bytes, files: Mapping[str, bytes]) -> bytes:
    """SHA-256 of a world's document and of the files that it refers to."""
    digest = hashlib.sha256(document)
    for name, content in sorted(files.items()):
        digest.update(name.encode() + hashlib.sha256(content).digest())
    return digest.digest()


def real_path(path: Any) -> Path:
    """`path` without links, to be compared; for a store, or a folder that was found by a name with
    a scheme, that name.
    Links that lead in a circle stay: `Path.resolve` would raise RuntimeError, where who opens the
    path finds that nothing is there."""
    if not isinstance(path, Path):
        return Path(str(path))
    return Path(LOCATED[path][1]) if path in LOCATED else Path(os.path.realpath(path))


def check_target(path: Path) -> None:
    """Raise DatasetError unless `path` is free or a regular file: no device, pipe, folder or link
    is ever replaced."""
    with disk_told(path), suppress(FileNotFoundError):
        mode = path.lstat().st_mode
        if stat.S_ISREG(mode):
            return
        what = "a symbolic link" if stat.S_ISLNK(mode) else "not a regular file"
        raise DatasetError(f"{path}: is {what}, and only files are replaced; give another name")


def writable(folder: Path) -> Path:
    """`folder`, or the nearest above it that is there. Raises DiskError where nothing may be
    written into that."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not os.access(there, os.W_OK):
        raise DiskError(f"{folder}: no permission to write there: choose another place")
    return there


def check_ours(path: Path) -> None:
    """Raise DatasetError unless `path` is free, or a file as this program wrote it: nobody else's
    is replaced, and none that somebody changed since. Where the file system keeps no attributes,
    nothing counts as written by it. Nor may its folder be one that cannot be written."""
    check_target(path)
    writable(path.parent)
    if path.exists() and not _is_marked(path):
        raise DatasetError(
            f"{path}: is there already, and not as scenegen wrote it; remove it, or give another "
            "name"
        )


def _is_marked(path: Path) -> bool:
    try:
        return int(os.getxattr(path, MARK)) == path.stat().st_mtime_ns
    except (OSError, ValueError):
        return False


def make_parent(path: Path) -> None:
    """Make the folder that `path` is to stand in. Raises DatasetError where that cannot be."""
    with disk_told(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)


def make_way(path: Path) -> None:
    """`make_parent`, and delete the drafts of `path` there that were left behind."""
    make_parent(path)
    remove_drafts(path.parent, path.name)


def write_whole(path: Path, content: bytes, *, sync: bool = True) -> None:
    """Put `content` at `path`: complete and on disk, or not at all; without `sync`, when the system
    sees fit. Raises as `whole`."""
    with _draft(path, sync) as file:
        file.write(content)


def write_result(path: Path, content: bytes) -> None:
    """Put at `path` what a user gave that name for. Raises as `check_ours` and `whole`."""
    check_ours(path)
    make_way(path)
    write_whole(path, content)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A file to write to, empty and there: when the block ends, it stands at `path`, complete and
    on disk; if it fails, nowhere.

    Raises DatasetError where the disk refuses, or where `path` is neither free nor a regular file.
    """
    with _draft(path) as file:
        yield Path(file.name)


def check_free(path: Path) -> None:
    """Raise DatasetError where there is something at `path`."""
    if path.exists() or path.is_symlink():
        raise DatasetError(f"{path}: is there already; give another name, or remove it")


@contextmanager
def whole_folder(path: Path, check: Callable[[Path], None] = check_free) -> Iterator[Path]:
    """A folder to write to: when the block ends, it stands at `path`, on disk, in place of what was
    there; if it fails, all is as it was. Before it begins and in the end, `check` raises an error
    where something stands there that must not be replaced.

    Raises DatasetError where the disk refuses.
    """
    check(path)
    make_way(path)
    draft, former = draft_of(path), draft_of(path)

    def clear() -> None:
        if former.exists() and not path.exists():
            former.rename(path)
        for stale in (draft, former):
            shutil.rmtree(stale, ignore_errors=True)

    with disk_told(path), undone(clear):
        draft.mkdir()
        yield draft
        sync_folder(draft)
        check(path)
        if path.exists():
            path.rename(former)
        draft.rename(path)
        sync_folder(path.parent)


def claim(folder: Path, name: str, about: Json) -> Collection[str]:
    """The names of what is in `folder`, made where it is not: nothing, or what a run began that is
    `about` the same, as its file `name` says from now on. Raises DatasetError where it is anything
    else."""
    content = json.dumps(about, indent=1).encode()
    with disk_told(folder):
        folder.mkdir(parents=True, exist_ok=True)
        remove_drafts(folder)
        # listed first: what another process begins meanwhile, it begins with that file
        there = names_in(folder)
    state = folder / name
    if begun := state.exists():
        wrong = read_bounded(state, MOST_MANIFEST_BYTES) != content
    else:
        wrong = any(not one.endswith(".tmp") for one in there)
    if wrong:
        raise DatasetError(
            f"{folder}: holds other files, or what another command began; choose another folder"
        )
    if not begun:
        write_whole(state, content)
    return there


@contextmanager
def _draft(path: Path, sync: bool = True) -> Iterator[BinaryIO]:
    """What `whole` gives, opened for writing under its name."""
    check_target(path)
    draft = draft_of(path)
    # a file of its own: where somebody else's has this name, it stays
    with (
        disk_told(path),
        open(draft, "xb") as file,
        undone(lambda: draft.unlink(missing_ok=True)),
    ):
        yield file
        file.flush()
        there = os.fstat(file.fileno())
        with suppress(OSError):
            os.setxattr(file.fileno(), MARK, str(there.st_mtime_ns).encode())
        if sync:
            os.fsync(file.fileno())
        if not os.path.samestat(draft.lstat(), there):
            raise DatasetError(f"{path}: was exchanged while it was written")
        check_target(path)
        draft.replace(path)
        if sync:
            sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Put a folder's entries on disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def disk_told(path: object) -> Iterator[None]:
    """An operating system's refusal in the block comes out as a DiskError about `path`, with
    what a user can do about it."""
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
    """A new name beside `path` that nobody can guess. It says for which name and by which process
    it is, so that `remove_drafts` finds what this program left behind, and nothing else."""
    pid, secret = os.getpid(), secrets.token_hex(8)
    said = f"{_digest(path.name)}-{_machine()}-{pid}-{_own_start(pid)}-{secret}"
    return path.with_name(f".scenegen-{said}.tmp")


def names_in(folder: Path) -> set[str]:
    """Names of what lies in a dataset's folder, and of what lies in its folders of shards."""
    names = {item.name for item in os.scandir(folder)}
    for part in filter(PART.fullmatch, list(names)):
        with suppress(NotADirectoryError):
            within = {f"{part}/{item.name}" for item in os.scandir(folder / part)}
            names = names - {part} | within
    return names


def remove_drafts(folder: Path, target: str | None = None) -> None:
    """Delete drafts in `folder`, and in folders of shards in it, that this user's scenegen made, of
    `target` alone if that is given, and whose writer is gone: an ended process of this machine, or
    one of another machine that wrote nothing for `STALE_S`."""
    like = ".scenegen-*.tmp"
    for draft in (*folder.glob(like), *folder.glob(f"*-*x/{like}")):
        said = DRAFT.fullmatch(draft.name)
        if not said or (target and said[1] != _digest(target)):
            continue
        with suppress(OSError):  # another process may be removing it
            status = draft.lstat()
            if status.st_uid != os.geteuid() or not _is_gone(said, status.st_mtime):
                continue
            if stat.S_ISDIR(status.st_mode):
                shutil.rmtree(draft, ignore_errors=True)
            elif stat.S_ISREG(status.st_mode):
                draft.unlink()


def _is_gone(said: re.Match[str], modified_s: float) -> bool:
    """Whether the process that a draft's name tells of has ended."""
    _, machine, pid, start = said.groups()
    if machine == _machine():
        return _start_of(int(pid)) != int(start)
    return time.time() - modified_s > STALE_S


def _start_of(pid: int) -> int:
    """When a process began, in clock ticks since the machine did: numbers of processes are used
    again. 0 for one that is not there."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    return 0 if fields[0] in "ZX" else int(fields[19])


@cache  # each look takes as long as making a small file
def _own_start(pid: int) -> int:
    """That of this process, which stays."""
    return _start_of(pid)


@cache
def _machine() -> str:
    """This machine, or container: where a process's number means that process."""
    return _digest(f"{socket.gethostname()} {Path('/proc/self/ns/pid').readlink()}")


def _digest(text: str) -> str:
    return sha256_of(os.fsencode(text))[:12]
