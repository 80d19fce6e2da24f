"""Predictions that somebody else made, in an HDF5 file, as a row of the bench."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import isal.isal_zlib
import numpy as np

from lidarsim import GridSpec
from scenegen.dataset.layout import FILTERS, Column, unpack
from scenegen.dataset.read import Dataset
from scenegen.errors import DatasetError, GuardError, printable, short
from scenegen.files import open_bounded
from scenegen.limits import GUARD_BYTES, GUARD_S, MOST_CHUNK_BYTES
from scenegen.model.completion.protocol import PARTS, Prediction, PredictionError, check_prediction
from scenegen.sample import Sample
from scenegen.workers import guarded

WHO = ("world", "viewpoint")
"""Names of the columns that say which sample a row predicts."""


@dataclass(frozen=True)
class Predicted:
    """Predictions in an HDF5 file: `occupancy_probability` and/or `tudf`, float32 (N, *grid.shape), and who is who:
    attribute `dataset` (the dataset's digest), `world` and `viewpoint`, int64 (N,), and `split`, an attribute."""

    path: Path
    name: str = field(default="predicted")

    def check(self, dataset: Dataset, split: str) -> None:
        """Raise DatasetError unless the file predicts every sample of `split` of `dataset` once, on its grid, in
        numbers that can be.

        Another process, with limits, reads all of it first: HDF5 could make a small file large. That costs about as
        much as reading the file.
        """
        names = [name[1:] for name in dataset.split(split).names]
        digest, shape = str(dataset.manifest.digest), dataset.grid.shape
        voxels = math.prod(shape)
        task = _Wanted(self.path, str(dataset.folder), digest, split, tuple(names), shape)
        try:
            with open_bounded(self.path, 1 << 62):
                pass
            guarded(_check_file, task, seconds=GUARD_S + len(names) * voxels / 1e6, memory_bytes=GUARD_BYTES)
        except FileNotFoundError:
            raise DatasetError(f"{self.path}: no such file; give an HDF5 file of predictions") from None
        except GuardError as error:
            raise DatasetError(f"{self.path}: cannot be read as HDF5 predictions ({error})") from None

    @cached_property
    def _rows(self) -> dict[tuple[str, int, int], int]:
        """Row of every (split, world, viewpoint)."""
        with h5py.File(self.path, "r") as file:
            return {(str(file.attrs["split"]), *pair): row for row, pair in enumerate(_pairs(file))}

    def completion(self, sample: Sample, *, split: str, grid: GridSpec, lidar: Any) -> Prediction:
        """See `Method.completion`. Raises KeyError for a sample that the file does not predict."""
        row = self._rows[split, int(sample.world), int(sample.viewpoint)]
        with h5py.File(self.path, "r") as file:
            return _prediction(file, row)


@dataclass(frozen=True)
class _Wanted:
    """What a predictions file must predict."""

    path: Path
    folder: str
    digest: str
    split: str
    names: tuple[tuple[int, int], ...]
    """(world, viewpoint) of every sample."""
    shape: tuple[int, int, int]


def _check_file(wanted: _Wanted) -> None:
    """Raise DatasetError unless the file at `wanted.path` predicts what is `wanted`."""
    try:
        with h5py.File(wanted.path, "r") as file:
            _check_names(file, wanted)
            for row in range(len(wanted.names)):
                check_prediction(_prediction(file, row), wanted.shape, f"row {row}")
    except (DatasetError, PredictionError) as error:
        raise DatasetError(f"{wanted.path}: {error}") from None
    except Exception as error:  # h5py's errors share no base
        raise DatasetError(f"{wanted.path}: cannot be read as HDF5 predictions: {printable(error)[:200]}") from None


def _check_names(file: h5py.File, wanted: _Wanted) -> None:
    digest, split = (str(file.attrs.get(name)) for name in ("dataset", "split"))
    if digest != wanted.digest:
        raise DatasetError(
            f"predicts dataset {printable(digest)[:12]}…, not {wanted.folder} ({wanted.digest[:12]}…); "
            "predict this one, and copy its digest into the attribute `dataset`"
        )
    if split != wanted.split:
        raise DatasetError(f"predicts split {short(split)}, expected {wanted.split!r}")
    links = {name: file.get(name, getlink=True) for name in (*WHO, *PARTS)}
    held = [name for name, link in links.items() if isinstance(link, h5py.HardLink)]
    if not set(WHO) < set(held) or any(link is not None for name, link in links.items() if name not in held):
        raise DatasetError(
            f"expected world, viewpoint, and at least one of {', '.join(PARTS)}, none of them a link; found {held}"
        )
    for name in held:
        maps = () if name in WHO else wanted.shape
        kinds = "iu" if name in WHO else "fiub"
        data = file[name]
        if not isinstance(data, h5py.Dataset) or data.is_virtual or data.external or data.dtype.kind not in kinds:
            raise DatasetError(f"{name} is no array of {'whole numbers' if name in WHO else 'float32'} in this file")
        if data.ndim < 1 or data.shape[1:] != maps:
            raise DatasetError(f"{name} holds maps of {data.shape[1:]}, expected {maps}")
        if data.shape[0] != file["world"].shape[0]:
            raise DatasetError(f"{name} has {data.shape[0]} rows, expected {file['world'].shape[0]}, as many as world")
        if data.chunks:
            _check_chunks(name, data)
    if file["world"].shape[0] > len(wanted.names):
        raise DatasetError(f"predicts {file['world'].shape[0]} samples, split {wanted.split} has {len(wanted.names)}")
    for name in held:  # HDF5 would make up zeros
        if file[name].size and file[name].id.get_space_status() != h5py.h5d.SPACE_STATUS_ALLOCATED:
            raise DatasetError(f"{name} is not written to its end; predict each sample of split {wanted.split} once")
    found = set(_pairs(file))
    missing = [name for name in wanted.names if name not in found]
    if missing:
        raise DatasetError(
            f"{len(missing)} of {len(wanted.names)} samples are missing, the first is world {missing[0][0]}, viewpoint "
            f"{missing[0][1]}; predict each sample of split {wanted.split} once"
        )


def _check_chunks(name: str, data: h5py.Dataset) -> None:
    """Raise DatasetError unless every chunk unpacks to just its size: HDF5 would take whatever comes out."""
    if math.prod(data.chunks) * data.dtype.itemsize > MOST_CHUNK_BYTES:
        raise DatasetError(f"{name} has chunks of {data.chunks}; store one map a chunk")
    plan = data.id.get_create_plist()
    filters = tuple(plan.get_filter(n)[0] for n in range(plan.get_nfilters()))
    if not set(filters) <= FILTERS:
        raise DatasetError(f"{name} has filters {filters}; store it plain or with gzip")
    column = Column(name, data.dtype, data.chunks, filters, np.empty((0, 4), np.int64))
    places: list[tuple[int, ...]] = []
    data.id.chunk_iter(lambda chunk: places.append(chunk.chunk_offset))
    for place in places:
        left_out, packed = data.id.read_direct_chunk(place)
        try:
            unpack(packed, column, left_out)
        except (ValueError, EOFError, isal.isal_zlib.error) as error:
            raise DatasetError(f"{name}: its chunk at {place} cannot be unpacked ({error})") from None


def _pairs(file: h5py.File) -> list[tuple[int, int]]:
    return list(zip(*(file[name][:].tolist() for name in WHO), strict=True))


def _prediction(file: h5py.File, row: int) -> Prediction:
    return Prediction(**{name: file[name][row].astype(np.float32) for name in PARTS if name in file})
