"""Columns of a table of points, by the names of its fields, or by its numbers.

Files without names (.bin, .npy, .npz) are refused unless the format, the user or the numbers
determine how many columns a point has."""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats
from scenegen.base.errors import printable

ORIGIN_PREFIXES = ("vp_", "viewpoint_", "sensor_", "origin_")
"""Prefixes of fields that hold a point's sensor position, before x, y and z; the first is that of
PCL's PointWithViewpoint."""
TIME_NAMES = ("t", "time", "timestamp", "time_stamp", "offset_time", "stamps", "time_offset")
"""Drivers' names of a point's time, by priority."""
TIME_PATTERN = re.compile(r"ts|dt|t_?(s|ms|us|ns|sec|nsec|offset)|.*(time|stamp).*", re.IGNORECASE)
"""Other names of fields that may be times."""
RING_NAMES = ("ring", "channel", "laser_id", "line")
"""Drivers' names of the number of the channel that saw a point, by priority."""
MAX_NAMES = 12
"""Field names in a message."""
MIN_COLUMNS, MAX_COLUMNS = 3, 8
"""Columns that a table without names may have unless a number is given."""
FAR_M, NEAR_M = 1e5, 1e-20
"""Bytes of other types, read as float32, mostly lie outside these bounds, zeros aside."""
PLAUSIBLE_SHARE = 0.9
"""Share of points that must lie between these; `check_scan` wants all."""
BLOCK, MAX_BLOCKS = 840, 100
"""Floats of a block, a multiple of every number of columns; and blocks that are compared."""
SAME_FIT = 0.95
"""A fit above this share of the best is as good: multiples of the right number always fit."""
CLEAR_FIT = 0.85
"""A number of columns is certain if all others, its multiples aside, fit worse than this share."""
CHANCE_SIGMA = 5
"""Standard deviations above the fit of identically distributed columns that rule out chance."""
HELP = "give --columns N, float32 numbers of a point, x y z first"


class CloudTable(NamedTuple):
    """The columns of a file that are used, and how they were read."""

    columns: Mapping[str, NDArray[Any]]
    """By name, (N,): x, y, z; the sensor's position, times and channels if there are some."""
    layout: str
    """For people: "x y z intensity (.pcd, binary)"."""
    origin: Floats | None = None
    """(1, 3): where the sensor was, by the file's header."""


def origin_fields(names: Collection[str]) -> list[str]:
    """Find the three of `names` that hold where a point was seen from; none if there are none."""
    triples = ([prefix + axis for axis in "xyz"] for prefix in ORIGIN_PREFIXES)
    return next((triple for triple in triples if set(triple) <= set(names)), [])


def time_fields(names: Sequence[str]) -> list[str]:
    """Find those of `names` that may be times, the likeliest first."""
    usual = [name for name in TIME_NAMES if name in names]
    return usual + [
        name for name in names if name not in TIME_NAMES and TIME_PATTERN.fullmatch(name)
    ]


def used_fields(names: Sequence[str]) -> list[str]:
    """Select the fields that are read.

    Args:
        names: All fields.

    Returns:
        x, y, z, and those of origins, times and channels.

    Raises:
        ValueError: If x, y or z is missing.
    """
    if not set("xyz") <= set(names):
        raise ValueError(f"has fields {short_list(names)}, expected x, y and z among them")
    rings = [name for name in RING_NAMES if name in names]
    return [*"xyz", *origin_fields(names), *time_fields(names), *rings]


def short_list(names: Sequence[str]) -> str:
    """List the first of some fields' names, for messages, without those that only fill gaps."""
    listed = [printable(name)[:30] for name in names if not re.fullmatch(r"_\d+", name)]
    hidden = len(listed) - MAX_NAMES
    return " ".join(listed[:MAX_NAMES]) + (f" and {hidden} more" if hidden > 0 else "")


def table_of_array(array: NDArray[Any], columns: int | None, kind: str) -> CloudTable:
    """Make a table of an array, (N, C) or (C, N), or with the fields of a structured one.

    Args:
        array: The array.
        columns: Numbers of a point; None to determine it.
        kind: The file type, for people.

    Returns:
        The table.

    Raises:
        ValueError: If the array has another shape, or rows and columns cannot be told apart.
    """
    if names := array.dtype.names:
        named = {name: array[name].reshape(-1) for name in used_fields(names)}
        return CloudTable(named, f"{short_list(names)} ({kind}, by names)")
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise ValueError(
            f"holds {array.dtype} of shape {array.shape}, expected (N, 3) numbers: x, y, z in "
            "metres"
        )
    transposed = _is_transposed(array.shape, columns)
    points = array.T if transposed else array
    sides = "rows" if transposed else "columns"
    return CloudTable(xyz_of(points), f"x y z ({kind}, {points.shape[1]} {sides})")


def xyz_of(points: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Name the first columns of points (N, 3 or more)."""
    return dict(zip("xyz", points.T, strict=False))


def _is_transposed(shape: tuple[int, ...], columns: int | None) -> bool:
    """Return whether an array's columns, and not its rows, are points. Raises ValueError if
    unclear."""
    rows, width = shape
    size = f"holds {rows} × {width} numbers"
    if columns is not None:
        if columns not in shape:
            raise ValueError(f"{size}, and --columns {columns}")
        # a square array has its points in rows
        return columns != width
    if width < MIN_COLUMNS:
        raise ValueError(f"{size}, expected (N, 3): x, y, z in metres")
    if rows in (3, 4) and 3 < width <= MAX_COLUMNS:  # 3 columns are never ambiguous
        raise ValueError(f"{size}, which may be {rows} points or {width}; give --columns N")
    if width > MAX_COLUMNS and rows not in (3, 4):
        raise ValueError(
            f"{size}, expected (N, 3) or (3, N), with {MAX_COLUMNS} columns at most; or give "
            "--columns N, x y z first"
        )
    return width > MAX_COLUMNS


def fitting_columns(values: NDArray[np.float32], usual: int | None = None) -> int:
    """Determine how many columns a point has in a file of float32 without names.

    There are two criteria. The first three columns are metres: within `FAR_M`, and not tiny as
    numbers of other types are when read as float32. And columns differ: heights from distances,
    intensities from both. Read with another number of columns, each column mixes all, and they are
    alike. The measure is the share of the variance of ranks, of the numbers and of their amounts,
    that lies between columns. If only one number of columns divides the file, no measure is needed.

    Args:
        values: The whole file, (n,).
        usual: The number of columns if the numbers do not determine it.

    Returns:
        The number of columns, `MIN_COLUMNS` to `MAX_COLUMNS`.

    Raises:
        ValueError: If none fits, or several do.
    """
    fits = {
        count: _column_fit(values, count)
        for count in range(MIN_COLUMNS, MAX_COLUMNS + 1)
        if len(values) and len(values) % count == 0
    }
    count = _best_fit(fits, len(values))
    if count is None and usual in fits:
        count = usual
    if fits and count is None:
        choices = " or ".join(map(str, fits))
        raise ValueError(f"may have {choices} columns, and its numbers do not tell; {HELP}")
    if count is None or not _is_plausible(values.reshape(-1, count)[:, :3]):
        raise ValueError(
            f"{4 * len(values)} bytes are no points of {MIN_COLUMNS} to {MAX_COLUMNS} float32, x y "
            f"z first, as KITTI has them; {HELP}"
        )
    return count


def _best_fit(fits: Mapping[int, float], size: int) -> int | None:
    """Return the number of columns that alone divides a file of `size` numbers, or fits far better
    than all others; None if there is none."""
    if len(fits) < 2:
        return next(iter(fits), None)
    best = max(fits.values())
    # multiples of the right number fit as well: the smallest is right
    count = min(count for count, fit in fits.items() if fit >= SAME_FIT * best)
    rivals = [fit for width, fit in fits.items() if width % count]
    # identically distributed columns stay below this: their fit times the numbers is chi squared
    chance = (count - 1 + CHANCE_SIGMA * (2 * count - 2) ** 0.5) / min(size, BLOCK * MAX_BLOCKS)
    clear = best > chance and max(rivals, default=0.0) < CLEAR_FIT * best - chance
    return count if clear else None


def _column_fit(values: NDArray[np.float32], count: int) -> float:
    """Measure how much the columns of `values` as rows of `count` differ, 0 to 1; see
    `fitting_columns`."""
    blocks = values[: len(values) // BLOCK * BLOCK].reshape(-1, BLOCK)
    if len(blocks):
        # blocks from all of the file, since its parts may differ
        values = blocks[:: math.ceil(len(blocks) / MAX_BLOCKS)]
    # rays without a return rank as zeros
    numbers = np.nan_to_num(values.reshape(-1), nan=0.0, posinf=0.0, neginf=0.0)
    shares = []
    for feature in (numbers, np.abs(numbers)):
        # ranks, so that a few huge numbers do not dominate
        ranks = np.unique(feature, return_inverse=True)[1].astype(float)
        means = ranks.reshape(-1, count).mean(axis=0)
        shares.append(means.var() / max(ranks.var(), 1e-12))
    return max(shares)


def _is_plausible(points: NDArray[np.float32]) -> bool:
    """Return whether nearly all of `points` (N, 3) may be metres, or rays without a return."""
    sizes = np.abs(points[np.isfinite(points).all(axis=1)])
    good = ((sizes == 0) | ((sizes > NEAR_M) & (sizes < FAR_M))).all(axis=1)
    return bool(np.count_nonzero(good) >= PLAUSIBLE_SHARE * len(good))
