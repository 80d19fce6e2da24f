"""Where a sensor was: poses in text files, and poses between those that are known."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from lidarsim import Pose
from lidarsim.grid import Floats
from lidarsim.pose import rotate, unit
from scenegen.errors import DatasetError, raised_as, short
from scenegen.files import read_bounded
from scenegen.limits import MOST_ASSET_BYTES

BEYOND_S = 0.1
"""How long before the first pose, or after the last, that pose still holds, seconds."""
SKEW = 0.01
"""How far a matrix may be from a rotation, and a quaternion's length from 1: six digits are
usual."""
TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
"""The columns of a TUM file, and of a CSV file that names none."""


@dataclass(frozen=True, eq=False)
class Track:
    """Poses over time."""

    times_s: Floats
    """(n,), seconds, rising; NaN where no time is known."""
    poses: Sequence[Pose]
    """As many."""

    def at(self, time_s: float) -> Pose | None:
        """The pose at a time: positions on a straight line, and attitudes on the shortest arc (as
        chords), between the two around it. None beyond the first and last by more than
        `BEYOND_S`."""
        times = self.times_s
        if not times[0] - BEYOND_S <= time_s <= times[-1] + BEYOND_S:
            return None
        where = float(np.interp(time_s, times, np.arange(len(times))))
        before = int(where)
        after = min(before + 1, len(times) - 1)
        return between(self.poses[before], self.poses[after], where - before)


def between(one: Pose, other: Pose, share: float) -> Pose:
    """The pose that lies `share` of the way from one to the other; beyond them, too."""
    a, b = one.quaternion, other.quaternion
    turned = (1 - share) * a + share * (b if a @ b >= 0 else -b)
    position = (1 - share) * one.position + share * other.position
    return Pose(position, unit(turned))


def inverse(pose: Pose) -> Pose:
    """The pose of the world in the frame of what stands at `pose`."""
    return Pose(-rotate(pose.back, pose.position), pose.back)


def read_poses(path: Path) -> Track:
    """The poses of a text file: matrices of 3 × 4 as KITTI has them, or time, position and
    quaternion, as TUM has them or under the names of `TUM` in a CSV file's first line.

    Raises DatasetError for anything else, and names the line.
    """
    names, rows = read_numbers(path)
    if not names and rows.shape[1] == 12:
        poses = [pose_of_matrix(row, f"{path}: line {n + 1}") for n, row in enumerate(rows)]
        return Track(np.full(len(rows), np.nan), poses)
    names = names or (TUM if rows.shape[1] == len(TUM) else ())
    if missing := [name for name in TUM if name not in names]:
        raise DatasetError(
            f"{path}: {rows.shape[1]} columns without {', '.join(missing)}; expected 12 as in "
            f"KITTI, or {', '.join(TUM)}"
        )
    table = rows[:, [list(names).index(name) for name in TUM]]
    rising = np.diff(table[:, 0]) > 0
    if not rising.all():
        n = int(np.argmin(rising)) + 2
        raise DatasetError(f"{path}: row {n}: expected a time above the one before")
    with raised_as(DatasetError):
        return Track(table[:, 0], poses_of(table[:, 1:], str(path)))


def poses_of(rows: Floats, where: str) -> list[Pose]:
    """The poses of positions and quaternions x y z w (n, 7). Raises ValueError, naming `where`, for
    one whose length is not 1."""
    lengths = np.sqrt((rows[:, 3:] ** 2).sum(axis=1, keepdims=True))
    wrong = ~(abs(lengths - 1) <= SKEW)
    if wrong.any():
        n = int(np.argmax(wrong))
        raise ValueError(
            f"{where}: row {n + 1}: expected a quaternion of length 1, not {lengths[n, 0]:g}"
        )
    return list(map(Pose, rows[:, :3], np.roll(rows[:, 3:], 1, axis=1) / lengths))


def read_numbers(path: Path) -> tuple[tuple[str, ...], Floats]:
    """A table of finite numbers, (rows, columns), and the names in its first line, if any; lines
    are passed over from # on. Raises DatasetError for anything else."""
    text = read_bounded(path, MOST_ASSET_BYTES).decode("latin-1")
    rows, names = list[list[float]](), tuple[str, ...]()
    for number, line in enumerate(text.replace(",", " ").splitlines(), start=1):
        words = line.partition("#")[0].split()
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
            if not rows and not names:
                names = tuple(words)
                continue
        width = len(names) or len((rows or [row])[0])
        if words and not (row and len(row) == width and all(map(math.isfinite, row))):
            raise DatasetError(
                f"{path}: line {number}: {short(line)}: expected {width} finite numbers"
            )
        if row:
            rows.append(row)
    if not rows:
        raise DatasetError(f"{path}: holds no numbers")
    return names, np.array(rows)


def pose_of_matrix(row: Floats, where: str) -> Pose:
    """The pose of a matrix of 3 × 4, row by row (12,). Raises DatasetError, naming `where`, for one
    that is no rotation."""
    matrix, turned = row.reshape(3, 4), np.empty(4)
    turn = matrix[:, :3]
    skew = abs(turn @ turn.T - np.eye(3)).max()
    if not skew <= SKEW or np.linalg.det(turn) < 0 or not np.isfinite(row).all():
        raise DatasetError(f"{where}: expected a rotation and a position, 3 × 4 row by row")
    mujoco.mju_mat2Quat(turned, np.ascontiguousarray(turn).reshape(-1))
    return Pose(matrix[:, 3], unit(turned))
