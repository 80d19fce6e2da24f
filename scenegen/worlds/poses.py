"""Poses of sensors: read from text files, and interpolated."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.parameters import short_repr
from lidarsim.pose import rotate, unit
from scenegen.base.errors import DatasetError, reraise_as
from scenegen.base.limits import MAX_ASSET_BYTES, MAX_HEADER_BYTES
from scenegen.base.reading import read_bounded

BEYOND_S = 0.1
"""The first pose holds for this time before it, the last one after it, seconds."""
SKEW = 0.01
"""Tolerance of a rotation matrix, and of a quaternion's length: files usually have six digits."""
TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
"""The columns of a TUM file, and of a CSV file that names none."""
TIME_NAME = re.compile(r"(?:.*\.)?(?:t|time_?stamp|time|stamp|secs?)(?:_(s|ms|us|ns))?")
FRACTION, FRACTION_NAME = "fraction", re.compile(r"(?:.*[._])?n(?:ano)?secs?")
"""The column of nanoseconds that some programs write beside one of whole seconds."""
AXIS_NAME = re.compile(
    r"(?:(?:.*\.)?(?:(q_rs|q|quat|quaternion|rot|rotation|orientation)"
    r"|p_rs_r|p|t|pos|position|translation)[_.]?)?([xyzw])"
)
"""Names of columns in other programs: EuRoC's p_RS_R_x and q_RS_w, tx, pos_x, position.x, q_x …"""
UNITS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9}
"""Units of time, seconds."""
MIN_UNIX_S = 1e9
"""A time above this (September 2001), and below ten times as much, counts seconds since 1970."""
MAX_STEP_S = 60.0
"""The time between scans or poses is at most this (median), seconds."""
MIN_LEVEL, MAX_TILTED = math.cos(math.radians(30)), math.cos(math.radians(60))
"""Bounds of the vertical part of a sensor's upward axis. Read in some order, quaternions are a
level sensor's if it is always above the first, a tilted one's if it ever falls below the second."""


@dataclass(frozen=True, eq=False)
class Track:
    """Poses over time."""

    times_s: Floats
    """(n,), seconds, rising; NaN where no time is known."""
    poses: Sequence[Pose]
    """n poses."""
    form: str = ""
    """How they were read from a file, for people."""

    @property
    def is_timed(self) -> bool:
        """Whether all times are known."""
        return bool(np.isfinite(self.times_s).all())

    def at(self, time_s: float) -> Pose | None:
        """Interpolate the pose at a time.

        Positions lie on a straight line, and attitudes on the shortest arc (as chords), between the
        two poses around it. Returns None beyond the first and last by more than `BEYOND_S`."""
        times = self.times_s
        if not times[0] - BEYOND_S <= time_s <= times[-1] + BEYOND_S:
            return None
        # beyond the ends, np.interp gives the end itself: it holds there
        position = float(np.interp(time_s, times, np.arange(len(times))))
        before = int(position)
        after = min(before + 1, len(times) - 1)
        return between(self.poses[before], self.poses[after], position - before)


def between(start: Pose, end: Pose, share: float) -> Pose:
    """Interpolate two poses, or extrapolate.

    Args:
        start: The pose at 0.
        end: The pose at 1.
        share: The place on the way.

    Returns:
        The pose.
    """
    a, b = start.quaternion, end.quaternion
    # a quaternion and its negative are one rotation: the nearer sign makes the shorter arc
    turned = (1 - share) * a + share * (b if a @ b >= 0 else -b)
    position = (1 - share) * start.position + share * end.position
    return Pose(position, unit(turned))


def inverse(pose: Pose) -> Pose:
    """Invert a pose: that of the world in the frame of a body at `pose`."""
    return Pose(-rotate(pose.back, pose.position), pose.back)


def read_poses(path: Path, *, timed: bool = True) -> Track:
    """Read the poses of a text file, whose form is determined by its header and content.

    Args:
        path: Matrices of 3 × 4, row by row, as KITTI writes them; or time, position and quaternion
            x y z w, as TUM does; or these columns in any order, with others among them, under names
            in the first line, or in a comment above the first row, as EuRoC writes them. Times are
            in the unit that the header names, or in one that `to_seconds` determines.
        timed: Whether times are needed.

    Returns:
        The poses; the times are NaN for matrices, and if they are not needed.

    Raises:
        DatasetError: The file has another form, or can be read in two ways. Names the line.
    """
    names, rows, comment = _read_table(path)
    # KITTI's files have no times: they are in a file of their own
    if not names and rows.shape[1] == 12:
        poses = [pose_of_matrix(row, f"{path}: line {n + 1}") for n, row in enumerate(rows)]
        return Track(np.full(len(rows), np.nan), poses, "matrices as KITTI's")
    if not names and any("q" in name for name, _ in _column_names(comment)):
        # EuRoC and others write the names in a comment; one without a quaternion's is prose
        names = comment
    named = _column_names(names or TUM[: rows.shape[1]])
    columns = {
        name: [n for n, (column, _) in enumerate(named) if column == name]
        for name in (*TUM, FRACTION)
    }
    missing = [name for name in TUM if not columns[name]]
    if missing or (not names and rows.shape[1] != len(TUM)):
        raise DatasetError(
            f"{path}: {rows.shape[1]} columns without {', '.join(missing) or 'names'}; expected 12 "
            f"as in KITTI, or {', '.join(TUM)}; others need their names in the first line"
        )
    if duplicates := [name for name in columns if len(columns[name]) > 1]:
        raise DatasetError(f"{path}: several columns for {duplicates[0]}; expected one called so")
    table = rows[:, [columns[name][0] for name in TUM]]
    # whole seconds and nanoseconds apart; without such a column the sum is 0
    table[:, 0] += 1e-9 * rows[:, columns[FRACTION]].sum(axis=1)
    _check_finite(table, path)
    rising = np.diff(table[:, 0]) > 0
    if not rising.all():
        n = int(np.argmin(rising)) + 2
        raise DatasetError(f"{path}: row {n}: expected a time above the one before")
    if not names:
        _check_order(table[:, 4:], path)
    with reraise_as(DatasetError):
        poses = poses_of(table[:, 1:], str(path))
    if not timed:
        return Track(np.full(len(rows), np.nan), poses)
    times_s, unit = to_seconds(
        table[:, 0], f"{path}: times", next((unit for _, unit in named if unit), "")
    )
    form = f"columns {' '.join(name for name, _ in named if name)}, t in {unit}"
    return Track(times_s, poses, form)


def write_tum(path: Path, rows: Iterable[tuple[float, Pose]]) -> None:
    """Write poses as TUM does: time in seconds, x y z in metres, quaternion x y z w.

    Args:
        path: The file, which is replaced.
        rows: Times and poses.
    """
    table = [
        [time, *pose.position, *pose.quaternion[1:], pose.quaternion[0]] for time, pose in rows
    ]
    np.savetxt(path, table, "%.15g")


def _column_names(names: Sequence[str]) -> list[tuple[str, str]]:
    """Recognize columns by name.

    Returns for each its name as in `TUM`, or "" for others, and a time's unit, if it is in the
    name. A column with exactly a name of `TUM` wins over others of that meaning."""
    plain = list[tuple[str, str]]()
    for name in names:
        # EuRoC writes `timestamp [ns]`
        bare, _, bracket = name.lower().replace(" ", "_").partition("[")
        bare = bare.strip("_")
        if time := TIME_NAME.fullmatch(bare):
            unit = (time[1] or bracket.strip("_]")).replace("us", "µs")
            plain.append(("t", unit if unit in UNITS else ""))
        elif FRACTION_NAME.fullmatch(bare):
            plain.append((FRACTION, ""))
        elif axis := AXIS_NAME.fullmatch(bare):
            # positions have no w
            quaternion = axis[1] or axis[2] == "w"
            plain.append((f"q{axis[2]}" if quaternion else axis[2], ""))
        else:
            plain.append(("", ""))
    return [
        ("", "") if alias != name and alias in names else (alias, unit)
        for name, (alias, unit) in zip(names, plain, strict=True)
    ]


def _check_order(turns: Floats, path: Path) -> None:
    """Raise DatasetError if quaternions (n, 4) of a file without names seem to be w x y z.

    They are read as x y z w; if they tilt the sensor in this order, and keep it level as w x y z,
    the order is ambiguous."""
    # how far up the sensor's vertical axis points, at least: 1 - 2 (x² + y²)
    as_read, w_first = ((1 - 2 * (turns[:, n : n + 2] ** 2).sum(axis=1)).min() for n in (0, 1))
    if as_read < MAX_TILTED and w_first > MIN_LEVEL:
        raise DatasetError(
            f"{path}: as x y z w its quaternions tilt the sensor, as w x y z they keep it level; "
            "name the columns in the first line: t x y z qx qy qz qw, or t x y z qw qx qy qz"
        )


def to_seconds(
    times: Floats, where: str, unit: str = "", near_s: Floats | None = None
) -> tuple[Floats, str]:
    """Determine the unit of rising times.

    Args:
        times: (n,), in an unknown unit.
        where: The beginning of an error's line.
        unit: The unit in `UNITS`, if it is known.
        near_s: Rising times that overlap with these, seconds.

    Returns:
        The times in seconds, and their unit: that in which they lie between 2001 and 2286, or
        overlap with those near them, or seconds; if the median step from one to the next is at most
        `MAX_STEP_S`.

    Raises:
        DatasetError: If the steps are longer than that, so that the unit cannot be determined.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    for name, scale in UNITS.items():
        first, last = times[0] * scale, times[-1] * scale
        # seconds since 1970, if the unit is this one
        likely = MIN_UNIX_S <= last < 10 * MIN_UNIX_S
        if near_s is not None:
            likely |= first <= near_s[-1] and last >= near_s[0]
        if name == unit or (not unit and likely and step * scale <= MAX_STEP_S):
            return times * scale, name
    if step > MAX_STEP_S:
        raise DatasetError(
            f"{where} are {step:.6g} apart (median), from {times[0]:.12g} to {times[-1]:.12g}; "
            "expected seconds, or ms, µs or ns since 1970; else name the unit in a header: t[ns]"
        )
    return times, "s"


def poses_of(rows: Floats, where: str) -> list[Pose]:
    """Make poses of positions and quaternions.

    Args:
        rows: (n, 7): x y z, metres, then x y z w.
        where: The rows' source, for messages.

    Returns:
        n poses.

    Raises:
        ValueError: If a quaternion's length is not 1.
    """
    lengths = np.sqrt((rows[:, 3:] ** 2).sum(axis=1, keepdims=True))
    wrong = ~(abs(lengths - 1) <= SKEW)
    if wrong.any():
        n = int(np.argmax(wrong))
        raise ValueError(
            f"{where}: row {n + 1}: expected a quaternion of length 1, not {lengths[n, 0]:g}"
        )
    # files end quaternions with w, a `Pose` begins with it
    return list(map(Pose, rows[:, :3], np.roll(rows[:, 3:], 1, axis=1) / lengths))


def read_numbers(path: Path) -> tuple[tuple[str, ...], Floats]:
    """Read a table of finite numbers; comments begin with #.

    Args:
        path: The file.

    Returns:
        The names in its first line, if any; and the numbers, (rows, columns).

    Raises:
        DatasetError: If it is not such a table.
    """
    names, rows, _ = _read_table(path)
    _check_finite(rows, path)
    return names, rows


def _check_finite(rows: Floats, path: Path) -> None:
    """Raise DatasetError for a row with a word, NaN or infinity."""
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        raise DatasetError(f"{path}: row {np.argmin(finite) + 1}: expected finite numbers")


def _read_table(path: Path) -> tuple[tuple[str, ...], Floats, tuple[str, ...]]:
    """Read a table as `read_numbers` does, with NaN for words in columns that have names; and the
    names in the last comment above the first row, if they are as many as its columns."""
    # decodes any byte: a file of another type is refused for its first line, with its number
    text = read_bounded(path, MAX_ASSET_BYTES).decode("latin-1")
    rows, names, comment = list[list[float]](), tuple[str, ...](), tuple[str, ...]()
    for number, line in enumerate(text.splitlines(), start=1):
        content, _, remark = line.partition("#")
        words = content.replace(",", " ").split()
        if not words and not rows:
            comment = _cells(remark) or comment
        row = list(map(_number, words))
        finite = all(map(math.isfinite, row))
        # a first line with words is the header
        if not (finite or rows or names):
            names = _cells(content)
            continue
        width = len(names) or len((rows or [row])[0])
        if words and not (len(row) == width and (finite or names)):
            raise DatasetError(
                f"{path}: line {number}: {short_repr(line)}: expected {width} finite numbers"
            )
        if row:
            rows.append(row)
    if not rows:
        raise DatasetError(f"{path}: holds no numbers")
    return names, np.array(rows), comment if len(comment) == len(rows[0]) else ()


def _number(word: str) -> float:
    """Convert a word to a number, NaN if it is none."""
    try:
        return float(word)
    except ValueError:
        return math.nan


def _cells(line: str) -> tuple[str, ...]:
    """Split a line into names of columns, at commas or spaces, each with its unit in brackets."""
    joined = re.sub(r"\s*[\[(]\s*([^\])]*?)\s*[\])]", r"[\1]", line)
    cells = joined.split(",") if "," in joined else joined.split()
    return tuple(filter(None, map(str.strip, cells)))


def pose_of_matrix(row: Floats, where: str) -> Pose:
    """Make the pose of a 3 × 4 matrix.

    Args:
        row: (12,): the matrix, row by row.
        where: Its source, for messages.

    Returns:
        The pose.

    Raises:
        DatasetError: If it holds no rotation.
    """
    matrix, turned = row.reshape(3, 4), np.empty(4)
    turn = matrix[:, :3]
    # a rotation's rows are orthonormal; the determinant excludes mirrors
    skew = abs(turn @ turn.T - np.eye(3)).max()
    if not skew <= SKEW or np.linalg.det(turn) < 0 or not np.isfinite(row).all():
        raise DatasetError(f"{where}: expected a rotation and a position, 3 × 4 row by row")
    mujoco.mju_mat2Quat(turned, np.ascontiguousarray(turn).reshape(-1))
    return Pose(matrix[:, 3], unit(turned))


def read_tr(calibration: Path) -> Floats | None:
    """Read the sensor's pose in the frame of KITTI's camera.

    Args:
        calibration: A calib.txt.

    Returns:
        The numbers of its line Tr (12,); None if there is none.

    Raises:
        DatasetError: If the line does not have 12 numbers.
    """
    text = read_bounded(calibration, MAX_HEADER_BYTES) if calibration.exists() else b""
    for line in text.decode("latin-1").splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() == "Tr":
            with reraise_as(DatasetError, f"{calibration}: Tr: expected 12 numbers: "):
                return np.array(numbers.split(), float).reshape(12)
    return None


def has_camera(calibration: Path) -> bool:
    """Return whether a calib.txt of KITTI's has a camera that is not the sensor. Raises as
    `read_tr`."""
    row = read_tr(calibration)
    return row is not None and not np.allclose(row, np.eye(4)[:3].reshape(-1))
