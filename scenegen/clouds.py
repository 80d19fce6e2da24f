"""Point clouds on disk, read here so that no file takes more memory than it has content."""

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.grid import Floats
from scenegen.cloud_arrays import (
    read_archive,
    read_array,
    read_bin,
    read_kitti,
    read_nuscenes,
    read_xyz,
)
from scenegen.cloud_fields import Table, read_las, read_pcd, read_ply
from scenegen.errors import DatasetError, needs, printable
from scenegen.files import read_bounded
from scenegen.limits import MOST_POINTS, MOST_SCAN_BYTES

MOST_SCANS = 100_000
"""The most scans of a folder."""
MOST_DIGITS = 255
"""The most digits of a number in a file's name."""
KITTI_FOLDER = "velodyne"
"""What KITTI calls the folder of a sequence's clouds."""
MAX_SCAN_M = 1e5
"""No sensor has a return from farther away than this, metres."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points, and where they were seen from."""

    points: Floats
    """(N, 3), metres; a point of NaN or infinity is a ray that returned nothing."""
    sensors: Floats | None
    """(N, 3) or, the same for all, (1, 3): where the sensor was, in the points' frame, metres. None
    where the file does not say."""
    layout: str
    """What was taken of the file, for people: "x y z intensity (KITTI .bin, 4 columns)"."""


def read_points(path: Path, columns: int | None = None) -> Floats:
    """The points of a scan, as `Cloud` has them. Raises as `read_cloud`."""
    return read_cloud(path, columns=columns).points


def read_cloud(
    path: Path, most_bytes: int = MOST_SCAN_BYTES, *, columns: int | None = None
) -> Cloud:
    """Read the points of a file.

    Args:
        path: One of the file types in `READERS`.
        most_bytes: The largest file that is read.
        columns: Numbers of a point in a file whose columns have no names; by default what the
            format, or the numbers, tell.

    Raises:
        DatasetError: The file holds no points, fewer than it promises, or points that cannot be
            told; it is too large; or `columns` are given and its fields have names.
    """
    if (kind := _kind(path)) not in READERS:
        raise DatasetError(
            f"{path}: neither a dataset's folder nor a scan; expected one of {', '.join(READERS)}"
        )
    if columns is not None and kind not in UNNAMED:
        raise DatasetError(f"{path}: --columns is for {', '.join(UNNAMED)}; leave it out for this")
    content = read_bounded(path, most_bytes)
    try:
        if kind in NAMED:
            found, layout = NAMED[kind](content)
        else:
            reader = UNNAMED[kind]
            if kind == ".bin" and path.parent.name == KITTI_FOLDER:
                reader = read_kitti
            found, layout = reader(content, columns)
    except ModuleNotFoundError:
        raise DatasetError(f"{path}: {needs('laspy and lazrs', 'las')}") from None
    except Exception as error:  # numpy's parsers raise anything
        raise DatasetError(f"{path}: cannot be read as {kind}: {printable(error)[:300]}") from None
    if found.ndim != 2 or found.shape[1] < 3 or not len(found) or found.dtype.kind not in "fiu":
        raise DatasetError(
            f"{path}: holds {found.dtype} of shape {found.shape}, expected (N, 3) numbers, N "
            f"from 1 on: x, y, z in metres"
        )
    if len(found) > MOST_POINTS:
        raise DatasetError(
            f"{path}: holds more than {MOST_POINTS} points; give one scan, not a map of many"
        )
    sensors = found[:, 3:].astype(np.float64) if found.shape[1] == 6 else None
    return Cloud(found[:, :3].astype(np.float64), sensors, layout)


def check_scan(points: Floats, sensors: ArrayLike, where: str) -> None:
    """Refuse what no sensor returns.

    Args:
        points: (N, 3), metres.
        sensors: Where they were seen from, (3,), (1, 3) or (N, 3), in the same frame.
        where: What the error names, a file.

    Raises:
        DatasetError: A finite point is farther than `MAX_SCAN_M` from its sensor.
    """
    away = np.abs(points - np.asarray(sensors, float)).max(axis=1)
    far = np.isfinite(away) & (away > MAX_SCAN_M)
    if far.any():
        raise DatasetError(
            f"{where}: {np.count_nonzero(far)} of {len(points)} points lie up to "
            f"{away[far].max():.3g} m from the sensor, expected {MAX_SCAN_M:g} m at most; give "
            "metres, where the sensor is, and NaN where nothing returned"
        )


@dataclass
class ReadReport:
    """Counts what was read. Its text is a line for people."""

    clouds: int = 0
    points: int = 0
    dropped: int = 0
    """Points that are no returns."""
    layouts: dict[str, None] = field(default_factory=dict)
    """Those of all clouds, in the order in which they came."""

    def add(self, points: int, layout: str, dropped: int) -> None:
        """Count a cloud of so many `points`, `dropped` of which are no returns; for its `layout`
        see `Cloud`."""
        self.clouds += 1
        self.points += points
        self.dropped += dropped
        self.layouts[layout] = None

    def __str__(self) -> str:
        several = f"{self.clouds:,} clouds, " if self.clouds > 1 else ""
        lost = f"; {self.dropped:,} without a return dropped" if self.dropped else ""
        return f"read: {several}{self.points:,} points, {'; '.join(self.layouts)}{lost}"


NAMED: dict[str, Callable[[bytes], Table]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".las": read_las,
    ".laz": read_las,
    ".xyz": read_xyz,
}
"""File types of scans whose fields are known, and what reads each; see `READERS`."""
UNNAMED: dict[str, Callable[[bytes, int | None], Table]] = {
    ".bin": read_bin,
    ".pcd.bin": read_nuscenes,
    ".npy": read_array,
    ".npz": read_archive,
}
"""Those whose readers take a number of columns, or None."""
READERS = NAMED | UNNAMED
"""File types of scans, and what reads each: bytes to a `Table`. A reader may raise anything:
`read_cloud` makes one line of it."""


def _kind(path: Path) -> str:
    """The file type of a scan by its name, as `READERS` has it."""
    suffixes = [suffix.lower() for suffix in path.suffixes[-2:]]
    return next(
        (end for end in ("".join(suffixes), suffixes[-1] if suffixes else "") if end in READERS), ""
    )


def scans_in(folder: Path) -> list[Path]:
    """Files of these types in a folder and those below it, sorted, numbers in their names by value.
    Raises DatasetError for more than `MOST_SCANS`."""
    found = list(
        itertools.islice(
            (path for path in folder.rglob("*") if path.suffix.lower() in READERS), MOST_SCANS + 1
        )
    )
    if len(found) > MOST_SCANS:
        raise DatasetError(f"{folder}: holds more than {MOST_SCANS} scans; give a folder of fewer")
    return sorted(found, key=_by_number)


def _by_number(path: Path) -> tuple[Path, str, str]:
    """A path's place in its folder: 2.ply comes before 10.ply, scan_2.ply before scan_10.ply, and
    digits before letters. What follows a point are decimals."""
    padded = re.sub(r"(?<![\d.])\d+", lambda digits: digits[0].zfill(MOST_DIGITS), path.stem)
    return path.parent, padded, path.name
