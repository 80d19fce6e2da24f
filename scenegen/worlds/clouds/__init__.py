"""Point clouds on disk: one function reads a file of any format into one record, a `Cloud`.

`formats` turns the bytes of a file into columns, `columns` finds a point's position, its sensor's
and its time among them, and `read_cloud` makes the record. No file takes more memory than its
content does."""

import itertools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim.grid import Floats, Mask
from scenegen.base.errors import DatasetError, needs, printable
from scenegen.base.limits import MAX_POINTS, MAX_SCAN_BYTES
from scenegen.base.reading import read_bounded
from scenegen.worlds.clouds import formats
from scenegen.worlds.clouds.columns import RING_NAMES, CloudTable, origin_fields, time_fields

MAX_SCANS = 100_000
"""Scans of a folder."""
# Linux allows no longer names of files
MAX_DIGITS = 255
"""Digits of a number in a file's name."""
KITTI_FOLDER = "velodyne"
"""KITTI's name of the folder with a sequence's clouds."""
MAX_SCAN_M = 1e5
"""No sensor has a return from farther away than this, metres."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """The points of a file or a message, and what else it gives about them."""

    points: Floats
    """(N, 3), metres; a point of NaN or infinity is a ray that returned nothing."""
    layout: str
    """How the file was read, for people: "x y z intensity (KITTI .bin, 4 columns)"."""
    origins: Floats | None = None
    """(N, 3) or, the same for all, (1, 3): where the sensor was, in the points' frame, metres. None
    if the file does not say."""
    times: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Fields that may be times of the points, by name, (N,), as written."""
    rings: NDArray[Any] | None = None
    """(N,): numbers of the channels that saw the points; None if the file does not say."""

    @property
    def returned(self) -> Mask:
        """(N,): which points, in their sensor's frame, are neither missing nor 0 0 0."""
        return np.asarray(np.isfinite(self.points).all(axis=1) & self.points.any(axis=1))


def cloud_of(table: CloudTable) -> Cloud:
    """Make the cloud of a file's columns. Raises ValueError if these are not numbers."""
    columns = table.columns

    def stacked(names: list[str]) -> Floats:
        return np.stack([np.asarray(columns[name], np.float64) for name in names], axis=1)

    # float64: coordinates of surveys have more digits than float32 holds
    points = stacked([*"xyz"])
    origins = stacked(fields) if (fields := origin_fields(columns)) else table.origin
    times = {
        name: columns[name]
        for name in time_fields([*columns])
        if columns[name].shape == points.shape[:1] and columns[name].dtype.kind in "fiu"
    }
    rings = next((columns[name] for name in RING_NAMES if name in columns), None)
    return Cloud(points, table.layout, origins, times, rings)


def read_cloud(path: Path, max_bytes: int = MAX_SCAN_BYTES, *, columns: int | None = None) -> Cloud:
    """Read the points of a file.

    Args:
        path: One of the file types in `READERS`.
        max_bytes: The largest file that is read.
        columns: Numbers of a point in a file whose columns have no names; by default determined by
            the format, or the numbers.

    Returns:
        The points.

    Raises:
        DatasetError: If the file is too large, holds no points, fewer than it promises, or columns
            that cannot be determined; or if `columns` are given and its fields have names.
    """
    if (kind := _kind(path)) not in READERS:
        raise DatasetError(
            f"{path}: neither a dataset's folder nor a scan; expected one of {', '.join(READERS)}"
        )
    if columns is not None and kind not in UNNAMED:
        raise DatasetError(f"{path}: --columns is for {', '.join(UNNAMED)}; leave it out for this")
    content = read_bounded(path, max_bytes)
    try:
        if kind in NAMED:
            table = NAMED[kind](content)
        # KITTI's layout of folders decides if the numbers do not
        elif kind == ".bin" and path.parent.name == KITTI_FOLDER:
            table = formats.read_kitti(content, columns)
        else:
            table = UNNAMED[kind](content, columns)
        cloud = cloud_of(table)
    except ModuleNotFoundError:
        raise DatasetError(f"{path}: {needs('laspy and lazrs', 'las')}") from None
    except Exception as error:  # numpy's parsers raise anything
        raise DatasetError(f"{path}: cannot be read as {kind}: {printable(error)[:300]}") from None
    if not len(cloud.points):
        raise DatasetError(f"{path}: holds no points, expected (N, 3) numbers: x, y, z in metres")
    if len(cloud.points) > MAX_POINTS:
        raise DatasetError(
            f"{path}: holds more than {MAX_POINTS} points; give one scan, not a map of many"
        )
    return cloud


def check_scan(points: Floats, origins: ArrayLike, where: str) -> None:
    """Check that points may be a scan.

    Args:
        points: (N, 3), metres.
        origins: Where they were seen from, (3,), (1, 3) or (N, 3), in the same frame.
        where: The file's name, for the message.

    Raises:
        DatasetError: If a finite point is farther than `MAX_SCAN_M` from its sensor.
    """
    # the greatest coordinate, not the distance: no square overflows
    offset = np.abs(points - np.asarray(origins, float)).max(axis=1)
    far = np.isfinite(offset) & (offset > MAX_SCAN_M)
    if far.any():
        raise DatasetError(
            f"{where}: {np.count_nonzero(far)} of {len(points)} points lie up to "
            f"{offset[far].max():.3g} m from the sensor, expected {MAX_SCAN_M:g} m at most; give "
            "metres, where the sensor is, and NaN where nothing returned"
        )


@dataclass
class ReadReport:
    """Counts clouds and points that were read. Its text is a line for people."""

    clouds: int = 0
    points: int = 0
    dropped: int = 0
    """Points without a return."""
    layouts: dict[str, None] = field(default_factory=dict)
    """Those of all clouds, in the order in which they came."""

    def add(self, points: int, layout: str, dropped: int) -> None:
        """Count a cloud.

        Args:
            points: Its points.
            layout: See `Cloud`.
            dropped: Those of its points without a return.
        """
        self.clouds += 1
        self.points += points
        self.dropped += dropped
        self.layouts[layout] = None

    def __str__(self) -> str:
        several = f"{self.clouds:,} clouds, " if self.clouds > 1 else ""
        lost = f"; {self.dropped:,} without a return dropped" if self.dropped else ""
        return f"read: {several}{self.points:,} points, {'; '.join(self.layouts)}{lost}"


NAMED: dict[str, Callable[[bytes], CloudTable]] = {
    ".ply": formats.read_ply,
    ".pcd": formats.read_pcd,
    ".las": formats.read_las,
    ".laz": formats.read_las,
    ".xyz": formats.read_xyz,
}
"""File types whose fields have names, and their readers."""
UNNAMED: dict[str, Callable[[bytes, int | None], CloudTable]] = {
    ".bin": formats.read_bin,
    ".pcd.bin": formats.read_nuscenes,
    ".npy": formats.read_array,
    ".npz": formats.read_archive,
}
"""Those whose readers take a number of columns, or None."""
READERS = NAMED | UNNAMED
"""File types of scans, and their readers."""


def _kind(path: Path) -> str:
    """Return the file type of a scan by its name, as in `READERS`; "" if unknown."""
    name = path.name.lower()
    # the longest suffix wins: .pcd.bin over .bin
    return max((suffix for suffix in READERS if name.endswith(suffix)), key=len, default="")


def scans_in(folder: Path) -> list[Path]:
    """List files of these types in a folder and those below it, numbers in their names sorted by
    value.

    Args:
        folder: The folder.

    Returns:
        The files.

    Raises:
        DatasetError: If there are more than `MAX_SCANS`.
    """
    matches = (path for path in folder.rglob("*") if path.suffix.lower() in READERS)
    # one more than the limit shows that there are too many, without a list of all
    scans = list(itertools.islice(matches, MAX_SCANS + 1))
    if len(scans) > MAX_SCANS:
        raise DatasetError(f"{folder}: holds more than {MAX_SCANS} scans; give a folder of fewer")
    return sorted(scans, key=_by_number)


def _by_number(path: Path) -> tuple[Path, str, str]:
    """Return a path's sort key in its folder.

    2.ply comes before 10.ply, scan_2.ply before scan_10.ply, and digits before letters. Digits
    after a point are decimals."""
    padded = re.sub(r"(?<![\d.])\d+", lambda digits: digits[0].zfill(MAX_DIGITS), path.stem)
    return path.parent, padded, path.name
