"""HDF5 that anybody may have written: where its data lie.

A file of ours says so itself, behind what the HDF5 library reads. Of other files that library says
it; on hostile bytes it hangs, crashes or takes all memory, so it runs in a process of its own.
"""

import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import weakref
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.grid import Ints
from scenegen.errors import DatasetError, GuardError, printable, raised_as, short
from scenegen.files import open_bounded, pread, size_of
from scenegen.limits import GUARD_BYTES, GUARD_S, MOST_OBJECTS, MOST_TEXT_BYTES

SECONDS, MEMORY_BYTES = 20, 1 << 30
"""What the HDF5 library may take to index a file."""
MARK = b"scenegen index 1"
"""What a file of ours ends with, after its index and how long that is."""
MOST_INDEX_BYTES, INDEX_BYTES_A_CHUNK = 1 << 20, 2000
"""An index is no longer than this, and as much for every sample: parsing it takes many times that
memory."""
SERVE = f"from {__name__} import serve; serve()"
"""What the library's process runs."""


class Hdf5Error(ValueError):
    """A file is no sound HDF5, and why, in one line."""


class Stored(NamedTuple):
    """A dataset, as its file describes it."""

    dtype: np.dtype
    shape: tuple[int, ...]
    """(rows, *shape of a row)"""
    chunk: tuple[int, ...] | None
    """Shape of a chunk; None where the data are not stored in chunks."""
    filters: tuple[int, ...]
    """HDF5's numbers of them, in the order of writing."""
    places: Ints
    """(n, 4) of the stored chunks, if each is one row: row, first byte in the file, bytes, filters
    left out (bits)."""

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Stored)
            and self[:4] == other[:4]
            and np.array_equal(self.places, other.places)
        )

    @property
    def row_bytes(self) -> int:
        """The bytes of one row, unpacked."""
        return int(self.dtype.itemsize * math.prod(self.shape[1:]))


class Index(NamedTuple):
    """What a file's root group holds."""

    objects: Mapping[str, Stored]
    """The datasets."""
    attributes: Mapping[str, int | str | None]
    """Single whole numbers and texts; None for other values."""


class _Library:
    """A process that indexes one file after the other, and ends with this one."""

    def __init__(self) -> None:
        self._lock, (self._pipe, theirs) = threading.Lock(), socket.socketpair()
        self._answers = self._pipe.makefile("rb")
        code = f"import sys; sys.path[:] = {sys.path!r}; {SERVE}"
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", code],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                process_group=0,  # Ctrl-C is for this process to answer
            )
        weakref.finalize(self, _end, self._process, os.getpid())

    def ask(self, handle: int, most_chunks: int) -> bytes:
        """What `serve` answers of a file. Raises BrokenPipeError where the process is gone, and
        Hdf5Error where it ends meanwhile."""
        with self._lock:
            socket.send_fds(self._pipe, [b"%d" % most_chunks], [handle])
            answer = self._answers.readline()
        if answer.endswith(b"\n"):
            return answer
        late = self._process.wait() == -signal.SIGALRM
        what = "took too long" if late else "crashed, or took too much memory"
        raise Hdf5Error(f"the HDF5 library {what}")


def _end(process: "subprocess.Popen[bytes]", owner: int) -> None:
    if owner == os.getpid():  # not in a fork, whose parent's it is
        process.kill()
        process.wait()


_LIBRARIES: dict[int, _Library] = {}
"""The library of each process, by its number: a forked one has none yet."""


def with_index(content: bytes, file: Any, most_chunks: int) -> bytes:
    """The image of a file that is open in h5py, with its index behind it."""
    text = json.dumps(_index(file, most_chunks), sort_keys=True).encode()
    return b"".join([content, text, len(text).to_bytes(8, "little"), MARK])


def read_index(file: Any, most_chunks: int) -> Index:
    """The index of an open HDF5 file whose datasets have at most `most_chunks` chunks each: its
    own, or the library's. Raises Hdf5Error."""
    return _own(file, most_chunks) or library_index(file, most_chunks)


def tells(file: Any) -> bool:
    """Whether an open file ends as those do that tell their own index."""
    return pread(file, len(MARK), max(size_of(file) - len(MARK), 0)) == MARK


def _own(file: Any, most_chunks: int) -> Index | None:
    """What a file says of itself; None where it says nothing."""
    size, ending = size_of(file), len(MARK) + 8
    if not tells(file):
        return None
    tail = pread(file, ending, max(size - ending, 0))
    length = int.from_bytes(tail[:8], "little")
    most = MOST_INDEX_BYTES + INDEX_BYTES_A_CHUNK * most_chunks
    if length > min(most, size - ending):
        raise Hdf5Error(f"its index has {length} bytes")
    failed = (ValueError, TypeError, LookupError, AttributeError, RecursionError, zlib.error)
    with raised_as(Hdf5Error, "its index is damaged: ", of=failed):
        return _parsed(pread(file, length, size - ending - length), most_chunks)


def library_index(file: Any, most_chunks: int) -> Index:
    """What the HDF5 library says of an open file. The first call of a process takes 0.2 s, to begin
    the library's; others some 5 ms a shard. Raises Hdf5Error."""
    try:
        answer = _LIBRARIES[os.getpid()].ask(file.fileno(), most_chunks)
    except (KeyError, BrokenPipeError, ConnectionResetError):  # none yet, or somebody ended it
        library = _LIBRARIES[os.getpid()] = _Library()
        answer = library.ask(file.fileno(), most_chunks)
    if answer.startswith(b'"'):
        raise Hdf5Error(f"the HDF5 library does not read it: {json.loads(answer)}")
    return _parsed(answer, most_chunks)


def _parsed(text: bytes, most_chunks: int) -> Index:
    """The index in what `_index` made of a file, as JSON. Raises what a wrong one leads to."""
    found = json.loads(text)
    if not all(value is None or type(value) in (int, str) for value in found["more"].values()):
        raise ValueError("attributes are neither whole numbers nor texts")
    said = found["objects"].items()
    for name, what in said:
        if isinstance(what, str):
            raise Hdf5Error(f"{short(name)} {what}; only data of its own may be in a shard")
    return Index({name: _stored(one, most_chunks) for name, one in said}, found["more"])


def _stored(said: Any, most_chunks: int) -> Stored:
    dtype, shape, chunk, filters, places = said
    raw = zlib.decompressobj().decompress(bytes.fromhex(places), 32 * most_chunks + 1)
    rows = np.frombuffer(raw, "<i8").reshape(-1, 4).cumsum(axis=0)
    shape, chunk, filters = (tuple(map(int, part or ())) for part in (shape, chunk, filters))
    return Stored(np.dtype(str(dtype)), shape, chunk or None, filters, rows)


def serve() -> None:
    """Answer one line of JSON for every file that comes through the standard input: its index, or
    why there is none. The process ends if that takes too long."""
    import h5py

    from scenegen.run.workers import limit_memory

    limit_memory(MEMORY_BYTES)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # HDF5 lets no handler of Python's run
    with socket.socket(fileno=0) as pipe:
        while handles := (asked := socket.recv_fds(pipe, 20, 1))[1]:
            signal.alarm(SECONDS)
            answer: Any
            try:
                # HDF5 itself opens no file without a name, such as a copy of a store's
                with open(f"/dev/fd/{handles[0]}", "rb") as own, h5py.File(own, "r") as file:
                    answer = _index(file, int(asked[0]))
            except Exception as error:  # h5py's are of many kinds
                answer = printable(error)[:200] or type(error).__name__
            signal.alarm(0)
            os.close(handles[0])
            pipe.sendall(json.dumps(answer).encode() + b"\n")
    os._exit(0)  # at once: nobody waits for it


def _index(file: Any, most_chunks: int) -> Any:
    if max(len(file), len(file.attrs)) > MOST_OBJECTS:
        return f"more than {MOST_OBJECTS} objects or attributes"
    return {
        "objects": {name: _object(file, name, most_chunks) for name in file},
        "more": {name: _attribute(file.attrs, name) for name in file.attrs},
    }


def _object(file: Any, name: str, most_chunks: int) -> Any:
    import h5py  # which readers of our own files do without

    if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        return "is a link to elsewhere"
    dataset = h5py.h5o.open(file.id, name.encode())
    if not isinstance(dataset, h5py.h5d.DatasetID):
        return "is not a dataset"
    plan, shape, chunk = dataset.get_create_plist(), dataset.shape or (), None
    layout = plan.get_layout()
    if layout == h5py.h5d.VIRTUAL or plan.get_external_count():
        return "keeps its data in other files"
    filters = [plan.get_filter(n)[0] for n in range(plan.get_nfilters())]
    places: list[tuple[int, ...]] = []
    if layout == h5py.h5d.CHUNKED and (chunk := plan.get_chunk()) == (1, *shape[1:]):
        if dataset.get_num_chunks() > most_chunks:
            raise Hdf5Error(f"{name} has more than {most_chunks} chunks")
        dataset.chunk_iter(
            lambda it: places.append((it.chunk_offset[0], it.byte_offset, it.size, it.filter_mask))
        )
    # differences, which are small numbers, and of which many are the same
    rows = np.diff(np.array(places, "<i8").reshape(-1, 4), axis=0, prepend=0)
    packed = zlib.compress(rows.tobytes()).hex()
    return dataset.dtype.str, shape, chunk, filters, packed


def _attribute(attributes: Any, name: str) -> int | str | None:
    if attributes.get_id(name).shape != ():
        return None
    value = attributes[name]
    if isinstance(value, np.integer):
        return int(value)
    text = value.decode() if isinstance(value, bytes) else value
    return text if isinstance(text, str) and len(text) <= MOST_TEXT_BYTES else None


def read_guarded(
    read: Callable[[Path], Any], path: Path, most_bytes: int, seconds: float = GUARD_S
) -> Any:
    """What `read` makes of the HDF5 file at `path`, of at most `most_bytes` bytes, in a process
    with limits, of time among others: anybody may have written it. Raises DatasetError."""
    from scenegen.run.workers import guarded  # which takes time to import

    open_bounded(path, most_bytes).close()
    try:
        return guarded(read, path, seconds=seconds, memory_bytes=GUARD_BYTES)
    except GuardError as error:
        raise DatasetError(f"{path}: cannot be read as HDF5 ({error})") from None
