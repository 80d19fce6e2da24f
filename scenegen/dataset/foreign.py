"""HDF5 that other writers made, indexed by the HDF5 library in a process that may crash, hang or
take all memory."""

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from scenegen.dataset.hdf5 import (
    ELSEWHERE,
    LINK,
    NO_DATASET,
    TYPES,
    ForeignError,
    Hdf5Error,
    Index,
    Stored,
    walk,
)
from scenegen.errors import DatasetError, GuardError, printable
from scenegen.files import open_bounded
from scenegen.limits import GUARD_BYTES, GUARD_S, MOST_HEAP_BYTES, MOST_OBJECTS

SECONDS = 20.0
MEMORY_BYTES = 1 << 30
"""What the HDF5 library may take to index a file."""


def read_index(handle: int, path: Path, most_chunks: int) -> Index:
    """The index of the HDF5 file at `path`, which is open as `handle`; see `walk`.

    Opening a shard of our own takes some 1.5 ms; one that another writer made, some 30 ms more, for
    the process. Raises Hdf5Error.
    """
    try:
        return walk(handle, most_chunks)
    except ForeignError as error:
        reason = str(error)
    from scenegen.run.workers import (
        guarded,  # for such files alone: what it needs takes time to import
    )

    try:
        with _children_allowed():
            found = guarded(_index, (path, most_chunks), seconds=SECONDS, memory_bytes=MEMORY_BYTES)
    except GuardError as error:
        found = str(error)
    if isinstance(found, str):
        raise Hdf5Error(f"{reason}, and the HDF5 library does not read it: {found}")
    return found


def read_guarded(
    read: Callable[[Path], Any], path: Path, most_bytes: int, seconds: float = GUARD_S
) -> Any:
    """What `read` makes of the HDF5 file at `path`, of at most `most_bytes` bytes, in a process
    with limits, of time among others: anybody may have written it. Raises DatasetError."""
    from scenegen.run.workers import guarded

    try:
        with open_bounded(path, most_bytes):
            pass
        return guarded(read, path, seconds=seconds, memory_bytes=GUARD_BYTES)
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except GuardError as error:
        raise DatasetError(f"{path}: cannot be read as HDF5 ({error})") from None


@contextmanager
def _children_allowed() -> Iterator[None]:
    """Torch's loaders and verify's workers are daemons, which may start no process; this one ends
    before they do."""
    import multiprocessing

    process: Any = multiprocessing.current_process()
    settings: dict[str, Any] = process._config
    daemon = settings.pop("daemon", None)
    try:
        yield
    finally:
        if daemon is not None:
            settings["daemon"] = daemon


def _index(task: tuple[Path, int]) -> Index | str:
    """What `walk` gives, or in one line why there is none."""
    path, most_chunks = task
    signal.alarm(
        math.ceil(SECONDS) + 5
    )  # should the parent be gone: HDF5 lets no thread of Python's run meanwhile
    try:
        import h5py

        with h5py.File(path, "r") as file:
            if max(len(file), len(file.attrs)) > MOST_OBJECTS:
                return f"more than {MOST_OBJECTS} objects or attributes"
            objects = {name: _object(h5py, file, name, most_chunks) for name in file}
            return Index(objects, {name: _attribute(file.attrs, name) for name in file.attrs})
    except Exception as error:  # h5py's are of many kinds
        return printable(error)[:200] or type(error).__name__


def _object(h5py: Any, file: Any, name: str, most_chunks: int) -> Stored | str:
    if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        return LINK
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset):
        return NO_DATASET
    plan = dataset.id.get_create_plist()
    if dataset.is_virtual or plan.get_external_count():
        return ELSEWHERE
    filters = tuple(plan.get_filter(n)[0] for n in range(plan.get_nfilters()))
    places = []
    if dataset.shape and dataset.chunks == (1, *dataset.shape[1:]):
        if dataset.id.get_num_chunks() > most_chunks:
            raise Hdf5Error(f"{name} has more than {most_chunks} chunks")
        dataset.id.chunk_iter(
            lambda it: places.append((it.chunk_offset[0], it.byte_offset, it.size, it.filter_mask))
        )
    known = dataset.dtype if dataset.dtype in TYPES.values() else None
    return Stored(
        known,
        dataset.shape or (),
        dataset.chunks,
        filters,
        np.array(places, np.int64).reshape(-1, 4),
    )


def _attribute(attributes: Any, name: str) -> int | str | None:
    if attributes.get_id(name).shape != ():
        return None
    value = attributes[name]
    if isinstance(value, np.integer):
        return int(value)
    text = value.decode() if isinstance(value, bytes) else value
    return text if isinstance(text, str) and len(text) <= MOST_HEAP_BYTES else None
