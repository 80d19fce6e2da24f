"""Point clouds whose columns have no names: KITTI's .bin, NumPy's arrays and archives, and text.

The format, the user or the numbers tell how many columns a point has; where none does, the file is
refused.
"""

import io
import math
import re
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.sensors.table import read_npy
from scenegen.cloud_fields import Table, named, sensor_fields, text_numbers
from scenegen.limits import MOST_POINTS, MOST_SCAN_BYTES

MIN_COLUMNS, MAX_COLUMNS = 3, 8
"""Numbers of columns that a table of points may have unless a number is given."""
KITTI, NUSCENES = 4, 5
"""Columns of the two .bin formats that are known: x y z intensity, and these with the ring."""
FAR_M, NEAR_M = 1e5, 1e-20
"""Bytes that are no coordinates read as numbers beyond these, but for zeros."""
PLAUSIBLE_SHARE = 0.9
"""The share of points that must lie between these; `check_scan` of `scenegen.clouds` wants all."""
BLOCK, MAX_BLOCKS = 840, 100
"""Floats of a block, a multiple of every number of columns, and blocks in which these are
compared."""
SAME_FIT = 0.95
"""A number of columns fits as well as the best if its fit is above this share of that one's: twice
as many columns always do."""
CLEAR_FIT = 0.85
"""A number of columns is sure if the fit of others, but for its multiples, is below this share of
its own."""
CHANCES = 5
"""Standard deviations above the fit of columns that are alike from which on a fit is no chance."""
HELP = "give --columns N, float32 numbers of a point, x y z first"


def read_bin(content: bytes, columns: int | None, usual: int | None = None) -> Table:
    """Float32, point after point: as KITTI has it, x y z intensity; or of `columns` each. Where
    these are not given, they are seen by the numbers, see `fitting_columns`."""
    values = np.frombuffer(content, "<f4", len(content) // 4)
    count = columns or fitting_columns(values, usual)
    if len(content) % (4 * count):
        raise ValueError(f"{len(content)} bytes, no multiple of {count} float32; {HELP}")
    taken = "x y z intensity (KITTI .bin" if count == KITTI else "x y z (.bin"
    return values.reshape(-1, count)[:, :3], f"{taken}, {count} columns)"


def read_kitti(content: bytes, columns: int | None) -> Table:
    """A .bin in a folder of KITTI's layout, where 4 columns are usual: few points need not tell."""
    return read_bin(content, columns, KITTI)


def read_nuscenes(content: bytes, columns: int | None) -> Table:
    """NuScenes' .pcd.bin: float32, x y z intensity ring, point after point."""
    points, _ = read_bin(content, columns or NUSCENES)
    return points, f"x y z intensity ring (nuScenes .pcd.bin, {columns or NUSCENES} columns)"


def fitting_columns(values: NDArray[np.float32], usual: int | None = None) -> int:
    """How many columns a point has, `MIN_COLUMNS` to `MAX_COLUMNS`, in a file of `values`.

    Two things tell. The first three columns are metres: not beyond `FAR_M`, and not the tiny
    numbers as which other types read. And columns differ: heights from ways, intensities from both.
    Read with another number of columns, each column mixes all, and they are alike. The measure is
    the share of the variance of ranks, of the numbers and of their amounts, that lies between
    columns. Where one number of columns alone divides the file, it need not be seen.

    Args:
        values: The whole file, (n,).
        usual: The number of columns where the numbers do not tell; without it, that is an error.

    Returns:
        The number of columns.

    Raises:
        ValueError: None fits, or which one does cannot be seen.
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
    if count is None or not _plausible(values.reshape(-1, count)):
        raise ValueError(
            f"{4 * len(values)} bytes are no points of {MIN_COLUMNS} to {MAX_COLUMNS} float32, x y "
            f"z first, as KITTI has them; {HELP}"
        )
    return count


def _best_fit(fits: Mapping[int, float], size: int) -> int | None:
    """The number of columns that alone divides a file of `size` numbers, or fits far better than
    the others; None if there is none, see `fitting_columns`."""
    if len(fits) < 2:
        return next(iter(fits), None)
    best = max(fits.values())
    count = min(count for count, fit in fits.items() if fit >= SAME_FIT * best)
    others = [fit for other, fit in fits.items() if other % count]
    # what columns that are alike do not reach: their fit times the numbers is chi squared
    chance = (count - 1 + CHANCES * (2 * count - 2) ** 0.5) / min(size, BLOCK * MAX_BLOCKS)
    clear = best > chance and max(others, default=0.0) < CLEAR_FIT * best - chance
    return count if clear else None


def _plausible(table: NDArray[np.float32]) -> bool:
    """Whether the first columns of nearly all rows (N, C) may be metres, but for NaN and infinity,
    which are rays without a return."""
    finite = table[np.isfinite(table[:, :3]).all(axis=1), :3]
    sizes = np.abs(finite)
    good = ((sizes == 0) | ((sizes > NEAR_M) & (sizes < FAR_M))).all(axis=1)
    return bool(np.count_nonzero(good) >= PLAUSIBLE_SHARE * len(good))


def _column_fit(values: NDArray[np.float32], count: int) -> float:
    """How much the columns of `values` as rows of `count` differ, 0 to 1: see `fitting_columns`."""
    blocks = values[: len(values) // BLOCK * BLOCK].reshape(-1, BLOCK)
    if len(blocks):
        values = blocks[:: math.ceil(len(blocks) / MAX_BLOCKS)]
    numbers = np.nan_to_num(values.reshape(-1), nan=0.0, posinf=0.0, neginf=0.0)
    shares = []
    for feature in (numbers, np.abs(numbers)):
        ranks = np.unique(feature, return_inverse=True)[1].astype(float)
        means = ranks.reshape(-1, count).mean(axis=0)
        shares.append(means.var() / max(ranks.var(), 1e-12))
    return max(shares)


def read_array(content: bytes, columns: int | None) -> Table:
    """The points of NumPy's .npy file."""
    return _table(read_npy(content), columns, ".npy")


def read_archive(content: bytes, columns: int | None) -> Table:
    """The array `points` of NumPy's archive."""
    (points,) = read_npz(content, "points", most_bytes=MOST_SCAN_BYTES)
    return _table(points, columns, ".npz")


def _table(array: NDArray[Any], columns: int | None, kind: str) -> Table:
    """Points as rows of an array, (N, C) or (C, N), or with the fields of a structured one."""
    if names := array.dtype.names:
        fields = sensor_fields(names)
        if not set(fields) <= set(names):
            raise ValueError(f"has fields {named(names)}, expected x, y and z among them")
        points = np.stack([array[name].reshape(-1).astype(float) for name in fields], axis=1)
        return points, f"{named(names)} ({kind}, by names)"
    if array.ndim != 2:
        return array, kind
    shape = f"{len(array)} × {array.shape[1]}"
    turned = _is_turned(array.shape, columns, shape)
    points = array.T if turned else array
    return points[:, :3], f"x y z ({kind}, {points.shape[1]} {'rows' if turned else 'columns'})"


def _is_turned(shape: tuple[int, ...], columns: int | None, shown: str) -> bool:
    """Whether an array's columns are points, and not its rows. Raises ValueError where that cannot
    be seen."""
    rows, wide = shape
    if columns is not None:
        if columns not in shape:
            raise ValueError(f"holds {shown} numbers, and --columns {columns}")
        return columns != wide
    if rows in (3, 4) and 3 < wide <= MAX_COLUMNS:  # (N, 3) is what is asked for
        raise ValueError(
            f"holds {shown} numbers, which may be {rows} points or {wide}; give --columns N"
        )
    if wide > MAX_COLUMNS and rows not in (3, 4):
        raise ValueError(
            f"holds {shown} numbers, expected (N, 3) or (3, N), with {MAX_COLUMNS} columns at "
            "most; or give --columns N, x y z first"
        )
    return wide > MAX_COLUMNS


def read_xyz(content: bytes) -> Table:
    """Text: x, y and z are the first numbers of each line, unless its first line names others."""
    head, _, rest = content.partition(b"\n")
    words = head.decode("latin-1").lower().replace(",", " ").strip("#/ \r").split()
    columns = [0, 1, 2]
    if set(words) >= set("xyz"):
        columns, content = [words.index(axis) for axis in "xyz"], rest
    if re.search(rb"(?<!,)\b\d+,\d+[ \t]+[-+]?\d+,\d", content):
        raise ValueError("has commas within numbers, expected 3.5 and not 3,5")
    points = text_numbers(content.replace(b",", b" "), columns, MOST_POINTS + 1)
    return points, "x y z (.xyz, text)"


def read_npz(content: bytes, *names: str, most_bytes: int) -> list[np.ndarray]:
    """The arrays `names` of NumPy's archive, of at most `most_bytes` bytes each. Raises whatever a
    crafted file leads to."""
    found = list[np.ndarray]()
    with zipfile.ZipFile(io.BytesIO(content)) as members:
        for name in names:
            if f"{name}.npy" not in members.namelist():
                raise ValueError(_without(name, members.namelist()))
            about = members.getinfo(f"{name}.npy")
            if about.file_size > most_bytes:
                raise ValueError(
                    f"{name} of {about.file_size} bytes, expected {most_bytes} at most"
                )
            found.append(read_npy(members.read(about)))
    return found


def _without(name: str, members: list[str]) -> str:
    """What to say of an archive that lacks the array `name`."""
    if "states.npy" in members:  # see `scenegen.worlds.place`
        return (
            f"a map that scenegen map made, expected an array {name}; scenegen inspect tells of "
            "maps, scan and generate --scene fly through them"
        )
    arrays = [member.removesuffix(".npy") for member in members]
    return f"holds {named(arrays) or 'nothing'}, expected an array {name}"


def encode_npz(fields: Mapping[str, Any], level: int = 1) -> bytes:
    """NumPy's archive of arrays and texts by name, compressed at a zlib `level`, of which 1 is
    several times as fast as the usual one: the same bytes whenever it is made."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=level) as members:
        for name, values in fields.items():
            with members.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)
    return file.getvalue()
