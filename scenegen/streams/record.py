"""A sample as some twenty kilobytes, in which it travels between processes and lies in caches, and
as it was again."""

from typing import Any

import isal.isal_zlib
import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Sensor
from scenegen.sample import FIELDS, LazySample, Sample, derive_tudf, fields_of, shape_of

LEVEL = 1
"""The level of compression, as in shards."""


def record_type(grid: GridSpec, lidar: Sensor, scans: int = 1) -> np.dtype:
    """The record of one sample of so many scans: grids as bits, everything else as it is stored on
    disk. Distances follow from occupancy, and are ten times as large as all the rest: they are not
    in it."""
    columns: list[tuple[Any, ...]] = []
    for name in fields_of(scans, labels=False):
        if name != "tudf":
            shape = shape_of(name, grid, lidar, scans)
            bits = FIELDS[name]["axes"] == "grid"
            columns.append(
                (name, "u1", -(-int(np.prod(shape)) // 8))
                if bits
                else (name, FIELDS[name]["dtype"], shape)
            )
    return np.dtype(columns)


def pack(sample: Sample, kind: np.dtype) -> bytes:
    """A sample's record, compressed."""
    record = np.zeros((), kind)
    for name in kind.names or ():
        value = getattr(sample, name)
        record[name] = np.packbits(value) if FIELDS[name]["axes"] == "grid" else value
    return isal.isal_zlib.compress(record.tobytes(), LEVEL)


def unpack(packed: bytes, kind: np.dtype, grid: GridSpec, lidar: Sensor) -> Sample:
    """The sample of a record; arrays of its own, which may be written to. Raises ValueError for
    bytes that are none."""
    try:
        content = isal.isal_zlib.decompressobj().decompress(packed, kind.itemsize + 1)
    except isal.isal_zlib.error as error:
        raise ValueError(f"cannot be unpacked: {error}") from None
    if len(content) != kind.itemsize:
        raise ValueError(f"{len(content)} bytes, expected {kind.itemsize}")
    return _Drawn.of(np.frombuffer(content, kind)[0], grid, lidar)


class _Drawn(LazySample):
    """A sample whose fields are unpacked, and whose distances derived, when first asked for."""

    @classmethod
    def of(cls, record: Any, grid: GridSpec, lidar: Sensor) -> Sample:
        """The sample of a record."""
        sample = cls.__new__(cls)
        sample.__dict__.update(_record=record, _grid=grid, _lidar=lidar)
        return sample

    @property
    def names(self) -> tuple[str, ...]:
        """See `Sample.names`."""
        return fields_of(2 if "earlier_ranges" in self._record.dtype.names else 1, labels=False)

    def _sensor(self) -> Sensor:
        return self._lidar

    def find(self, name: str) -> Any:
        """See `LazySample.find`."""
        if name == "tudf":
            return derive_tudf(self.occupancy, grid=self._grid)
        value: NDArray[Any] = self._record[name]
        if FIELDS[name]["axes"] == "grid":
            count = int(np.prod(self._grid.shape))
            return np.unpackbits(value, count=count).view(np.bool_).reshape(self._grid.shape)
        return int(value) if FIELDS[name]["axes"] == "" else value.copy()
