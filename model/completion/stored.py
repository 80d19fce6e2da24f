"""Predictions in HDF5 files: written atomically with digests, and checked before use."""

import hashlib
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lidarsim.parameters import short_repr
from scenegen.base.errors import DatasetError, GuardError, printable, reraise_as
from scenegen.base.files import whole
from scenegen.base.limits import GUARD_BYTES, GUARD_S, MAX_CHUNK_BYTES
from scenegen.base.reading import open_bounded
from scenegen.base.workers import guarded
from scenegen.dataset.layout import READ_ERRORS, Chunks
from scenegen.dataset.shard import compress
from scenegen.model.calibration import StoredProbability
from scenegen.model.completion.protocol import (
    PARTS,
    STORED,
    Prediction,
    PredictionError,
    check_prediction,
)
from scenegen.model.config import HORIZONS

PACKED = {"compression": "gzip", "compression_opts": 1}
"""How HDF5 reads what `compress` made. HDF5 itself compresses nothing here: where a disk refuses
its chunks, it crashes."""
WHO = ("world", "viewpoint")
"""Names of the columns that say which sample a row predicts."""
SAMPLES = "sha256"
"""Name of the column with the digest of each row."""
OTHERS = "others"
"""Name of the attribute with the names of arrays of other targets than `PARTS`, after commas."""
DIGEST = "digest"
"""Name of the attribute with the digest of the file: of its other attributes, and of its columns or
maps."""


class _Disk(io.FileIO):
    """File below HDF5. A write that fails ends the writing at once. HDF5 writes more to close the
    file, and would fail again and again, so these writes are dropped."""

    refused = False

    def write(self, content: Any) -> int:
        """Write all of `content`, or nothing after the first error.

        Returns:
            Its bytes.

        Raises:
            OSError: The disk refuses, for the first time.
        """
        # the system may write a part of it only
        left = memoryview(content)
        try:
            while left.nbytes and not self.refused:
                left = left[super().write(left) :]
        except OSError:
            self.refused = True
            raise
        return memoryview(content).nbytes

    def truncate(self, size: int | None = None) -> int:
        """Truncate the file, unless the disk has refused."""
        return 0 if self.refused else super().truncate(size)


def read_guarded(
    read: Callable[[Path], Any], path: Path, max_bytes: int, seconds: float = GUARD_S
) -> Any:
    """Read a stranger's HDF5 file in a process with limits, see `guarded`.

    Args:
        read: Opens the file by its path; the result must be picklable.
        path: A regular file; a pipe is refused.
        max_bytes: The largest file that is read.
        seconds: How long `read` may take.

    Returns:
        The result of `read`.

    Raises:
        DatasetError: The file is missing or too large, or HDF5 crashes, hangs or swells on it.
        ScenegenError: `read` raises it.
    """
    open_bounded(path, max_bytes).close()
    try:
        return guarded(read, path, seconds=seconds, memory_bytes=GUARD_BYTES)
    except GuardError as error:
        raise DatasetError(f"{path}: cannot be read as HDF5 ({error})") from None


@contextmanager
def new_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open a new HDF5 file, which replaces `path` only once it is complete. Raises as `whole`.

    Yields:
        The file.
    """
    with whole(path) as draft, _Disk(draft, "r+") as disk, h5py.File(disk, "w") as file:
        yield file


def write_map(file: h5py.File, name: str, values: Any, *, row: int = 0, count: int = 0) -> None:
    """Write a map as one chunk.

    Args:
        file: The file.
        name: Name of the array.
        values: (X, Y, Z), or (channels, X, Y, Z).
        row: Row of the map in its array.
        count: Number of rows; 0: the map is an array of its own.
    """
    if name not in file:
        shape = (count, *values.shape) if count else values.shape
        chunks = (1, *values.shape) if count else values.shape
        file.create_dataset(name, shape, values.dtype, chunks=chunks, **PACKED)
    # compressed by us: HDF5 crashes if the disk refuses chunks that it compresses itself
    place = (row,) * bool(count) + (0,) * values.ndim
    file[name].id.write_direct_chunk(place, compress(values))


def digest_of(facts: Mapping[str, Any], arrays: Mapping[str, Any]) -> bytes:
    """Compute the SHA-256 of facts and arrays, whatever their order.

    Args:
        facts: The facts.
        arrays: The arrays by name.

    Returns:
        32 bytes.
    """
    text = json.dumps(dict(facts), sort_keys=True, default=_plain)
    digest = hashlib.sha256(text.encode())
    for name, values in sorted(arrays.items()):
        # type and shape, too: the same bytes of another shape are another map
        digest.update(f"{name} {values.dtype.str} {values.shape}".encode())
        digest.update(np.ascontiguousarray(values).data)
    return digest.digest()


def _plain(value: Any) -> Any:
    """Convert an attribute of HDF5 for JSON."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else repr(value)


def sample_digest(pair: Sequence[int], maps: Mapping[str, Any]) -> bytes:
    """Compute the SHA-256 of the prediction of a sample.

    Args:
        pair: Its world and viewpoint.
        maps: Arrays by name.

    Returns:
        32 bytes.
    """
    return digest_of(dict(zip(WHO, map(int, pair), strict=True)), maps)


def check_digest(file: h5py.File, names: Sequence[str]) -> None:
    """Check a file against the digest that was written with it.

    Args:
        file: The file.
        names: The arrays that the digest covers, besides all attributes.

    Raises:
        DatasetError: The file has no digest, or another.
    """
    facts = dict(file.attrs)
    digest = facts.pop(DIGEST, None)
    if digest != digest_of(facts, {name: file[name][()] for name in names}).hex():
        raise DatasetError("is not as it was written; complete it again")


def check_file(
    path: Path,
    *,
    facts: Mapping[str, str],
    max_samples: int,
    shape: tuple[int, ...],
    sealed: bool = False,
) -> list[tuple[int, int]]:
    """Check all of a file of predictions. HDF5 could make a small file large, so call this in a
    process with limits.

    Args:
        path: The file.
        facts: Its attributes, as they have to be.
        max_samples: How many samples it predicts at most.
        shape: The shape of a map.
        sealed: Whether it must have digests; if it has some, they must be right in any case.

    Returns:
        The samples, (world, viewpoint), that it predicts.

    Raises:
        DatasetError: It is anything else, or damaged.
    """
    wrong = reraise_as(DatasetError, f"{path}: ", of=(DatasetError, PredictionError))
    with wrong, h5py.File(path, "r") as file:
        for name, expected in facts.items():
            if (value := str(file.attrs.get(name))) != expected:
                raise DatasetError(
                    f"predicts {name} {short_repr(value)}, expected {short_repr(expected)}"
                )
        # files of other programs need no digests; one that has some was changed if they are wrong
        sealed = sealed or DIGEST in file.attrs
        columns = (*WHO, SAMPLES) if sealed else WHO
        _check_arrays(file, columns, max_samples, shape)
        if sealed:
            check_digest(file, columns)
        pairs = pairs_in(file)
        for row, pair in enumerate(pairs):
            check_prediction(prediction_at(file, row), shape, f"row {row}")
            # the file's digest covers the columns, and among them these digests of the maps
            maps = {name: file[name][row] for name in arrays_in(file)}
            if sealed and file[SAMPLES][row].tobytes() != sample_digest(pair, maps):
                raise DatasetError(
                    f"world {pair[0]}, viewpoint {pair[1]} is not as it was written; complete it "
                    "again"
                )
        return pairs


def _check_arrays(
    file: h5py.File, columns: Sequence[str], max_samples: int, shape: tuple[int, ...]
) -> None:
    """Raise DatasetError unless the arrays of a file of predictions are stored in it, and whole:
    one row a sample, at most so many, and maps of this shape."""
    others = others_in(file)
    links = {name: file.get(name, getlink=True) for name in (*columns, *STORED, *others)}
    names = [name for name, link in links.items() if link is not None]
    if not {*columns, *others} <= set(names) or not set(PARTS) & set(names):
        raise DatasetError(
            f"expected {', '.join((*columns, *others))}, and at least one of {', '.join(PARTS)}; "
            f"found {names}"
        )
    row_shapes = {"world": (), "viewpoint": (), SAMPLES: (32,)}
    for name in names:
        # other links lead to other files, as virtual and external data do
        data: Any = file[name] if isinstance(links[name], h5py.HardLink) else None
        is_here = isinstance(data, h5py.Dataset) and not data.is_virtual and not data.external
        kinds, numbers = ("iu", "whole numbers") if name in columns else ("fiub", "float32")
        if not is_here or data.dtype.kind not in kinds:
            raise DatasetError(f"{name} is no array of {numbers} in this file")
        expected = (*file["world"].shape[:1], *row_shapes.get(name, shape))
        if name in others and data.ndim == len(expected) + 1:  # which has channels
            expected = (expected[0], data.shape[1], *shape)
        if data.shape != expected:
            raise DatasetError(f"{name} has shape {data.shape}, expected {expected}")
        if data.chunks:
            _check_chunks(name, data)
    if (count := file["world"].shape[0]) > max_samples:
        raise DatasetError(f"predicts {count} samples, expected {max_samples} at most")
    for name in names:  # HDF5 would make up zeros
        if file[name].size and file[name].id.get_space_status() != h5py.h5d.SPACE_STATUS_ALLOCATED:
            raise DatasetError(f"{name} is not written to its end; predict each sample once")


def _check_chunks(name: str, data: h5py.Dataset) -> None:
    """Raise DatasetError unless every chunk unpacks to just its size: HDF5 would take whatever
    comes out."""
    with reraise_as(DatasetError, f"{name} ", of=ValueError):
        chunks = Chunks(data.id)
    if chunks.bytes > MAX_CHUNK_BYTES:
        raise DatasetError(f"{name} has chunks of {chunks.chunk}; store one map a chunk")
    places: list[tuple[int, ...]] = []
    data.id.chunk_iter(lambda chunk: places.append(chunk.chunk_offset))
    for place in places:
        with reraise_as(DatasetError, f"{name}: its chunk at {place} holds ", of=READ_ERRORS):
            chunks.read(place)


def about_others(prediction: Prediction) -> dict[str, str]:
    """Return the attribute that names the arrays of other targets than `STORED`; {} without any."""
    return {OTHERS: ",".join(prediction.others)} if prediction.others else {}


def others_in(file: h5py.File) -> list[str]:
    """Read the names of arrays of other targets.

    Args:
        file: The file.

    Returns:
        The names.

    Raises:
        DatasetError: No target has such a name.
    """
    text = str(file.attrs.get(OTHERS, ""))
    names = text.split(",") if text else []
    if len(set(names)) < len(names) or not all(
        (name.isidentifier() or name in HORIZONS) and name not in (*WHO, SAMPLES, *STORED)
        for name in names
    ):
        raise DatasetError(
            f"names targets {short_repr(text)}, expected names of arrays after commas"
        )
    return names


def arrays_in(file: h5py.File) -> list[str]:
    """Names of the arrays that a file predicts."""
    return [name for name in (*STORED, *others_in(file)) if name in file]


def pairs_in(file: h5py.File) -> list[tuple[int, int]]:
    """The sample, (world, viewpoint), of each row."""
    return list(zip(*(file[name][:].tolist() for name in WHO), strict=True))


def prediction_at(file: h5py.File, row: int) -> Prediction:
    """Read the prediction in a row.

    Args:
        file: The file.
        row: The row.

    Returns:
        The prediction, as float32 whatever is stored.
    """
    maps = {name: file[name][row] for name in arrays_in(file)}
    maps |= {name: maps[name].astype(np.float32) for name in STORED if name in maps}
    probability = maps.pop("probability", None)
    # the network that calibrated it is not at hand; its probabilities stand for it
    calibration = None if probability is None else StoredProbability(probability=probability)
    return Prediction.of(maps, calibration=calibration)


def prediction_facts(path: Path) -> dict[str, Any]:
    """Describe an HDF5 file of predictions, of a split or of one scan.

    Args:
        path: The file.

    Returns:
        The method and the dataset, and the shapes of the arrays.

    Raises:
        DatasetError: It is damaged, or something else.
    """
    return read_guarded(_facts, path, 1 << 62)


def _facts(path: Path) -> dict[str, Any]:
    with h5py.File(path, "r") as file:
        facts = {
            name: printable(file.attrs[name])[:100]
            for name in ("method", "split", "dataset")
            if name in file.attrs
        }
        parts = {name: list(file[name].shape) for name in arrays_in(file)}
        if "occupancy" in file and "method" not in facts:  # the truth
            raise DatasetError(
                f"{path}: is a shard of a dataset; inspect its folder, {path.parent}"
            )
    if not parts:
        raise DatasetError(f"{path}: holds no predictions; expected {' or '.join(PARTS)}")
    return {
        "predictions": str(path),
        **facts,
        "of": "a split" if "split" in facts else "a scan",
        "arrays": parts,
    }
