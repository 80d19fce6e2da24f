"""Where a body is and how it is turned."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats, finite
from lidarsim.jit import kernel


@dataclass(frozen=True, eq=False)
class Pose:
    """A body's position and attitude in the world frame, z up. Raises ValueError for a quaternion
    not of length 1."""

    position: Floats
    """(3,), metres."""
    quaternion: Floats
    """(4,), w x y z, unit length, as MuJoCo writes it: takes body coordinates to world
    coordinates."""

    def __post_init__(self) -> None:
        position = finite("pose: position", self.position, 3)
        quaternion = finite("pose: quaternion", self.quaternion, 4)
        length = float(np.sqrt((quaternion**2).sum()))
        if abs(length - 1.0) > 1e-6:
            raise ValueError(f"pose: quaternion has length {length:g}, expected 1 (w x y z)")
        # a unit quaternion keeps its bits, so that a stored pose reads as it was
        if abs(length - 1.0) > 1e-12:
            quaternion /= length
        for name, value in (("position", position), ("quaternion", quaternion)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def level(cls, position: ArrayLike, yaw_rad: float = 0.0) -> "Pose":
        """A body held level, turned by `yaw_rad` about the vertical, counter-clockwise seen from
        above."""
        sine, cosine = sin_cos(0.5 * yaw_rad)
        return cls(np.asarray(position, float), np.array([cosine, 0.0, 0.0, sine]))

    @classmethod
    def facing(cls, position: ArrayLike, direction: ArrayLike) -> "Pose":
        """A body held level that looks along `direction` (2,), x and y in the world, of any length.

        The half-angle formulas give the quaternion by square roots, without an angle, so with the
        same bits on every processor. Raises ValueError for a direction without length.
        """
        x, y = (float(part) for part in np.asarray(direction, float))
        length = math.sqrt(x * x + y * y)
        if not 0.0 < length < math.inf:
            raise ValueError(f"pose: direction = [{x:g}, {y:g}], expected a finite length above 0")
        large = math.sqrt(0.5 + 0.5 * abs(x) / length)
        small = 0.5 * y / length / large
        w, z = (large, small) if x >= 0.0 else (abs(small), math.copysign(large, y))
        return cls(np.asarray(position, float), np.array([w, 0.0, 0.0, z]))

    def to_body(self, points: Floats) -> Floats:
        """Points (..., 3) of the world, metres, in the body's frame."""
        return rotate(self.back, points - self.position)

    @property
    def back(self) -> Floats:
        """The quaternion that turns the other way, (4,): from the world's axes to the body's."""
        return self.quaternion * (1.0, -1.0, -1.0, -1.0)


def chained(parent: Pose, child: Pose) -> Pose:
    """The pose in the world of what stands at `child` in the frame of `parent`."""
    import mujoco  # which readers do without

    turned = np.empty(4)
    mujoco.mju_mulQuat(turned, parent.quaternion, child.quaternion)
    position = parent.position + rotate(parent.quaternion, child.position)
    return Pose(position, unit(turned))


def unit(quaternion: Floats) -> Floats:
    """A quaternion (4,) of length 1."""
    return quaternion / np.sqrt((quaternion**2).sum())


def rotate(quaternion: ArrayLike, vectors: ArrayLike) -> Floats:
    """`vectors` (..., 3) turned by the unit `quaternion` (4,), w x y z. Raises ValueError for
    arrays of other shapes, such as points with an intensity."""
    given = np.ascontiguousarray(vectors, float).view()
    if given.shape[-1:] != (3,):
        raise ValueError(f"vectors of shape {given.shape}, expected (..., 3)")
    # the kernel is compiled once, for what may be written to and for what may not
    given.setflags(write=False)
    turned = np.empty(given.shape)
    _rotate(np.array(quaternion, float), given.reshape(-1, 3), turned.reshape(-1, 3))
    return turned


@kernel
def _rotate(quaternion, vectors, turned):
    """Written out term by term, so that the result does not depend on which BLAS is installed."""
    w, x, y, z = quaternion
    for n in range(len(vectors)):
        a, b, c = vectors[n]
        turned[n, 0] = (
            (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c
        )
        turned[n, 1] = (
            2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c
        )
        turned[n, 2] = (
            2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c
        )
