"""Position and attitude of a body."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats, finite
from lidarsim.jit import kernel


@dataclass(frozen=True, eq=False)
class Pose:
    """A body's position and attitude in the world frame, z up. Raises ValueError if the
    quaternion's length is not 1."""

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
        """Make the pose of a level body.

        Args:
            position: (3,), metres, in the world.
            yaw_rad: Turn about the vertical, counter-clockwise seen from above.

        Returns:
            The pose.
        """
        sine, cosine = sin_cos(0.5 * yaw_rad)
        return cls(np.asarray(position, float), np.array([cosine, 0.0, 0.0, sine]))

    @classmethod
    def facing(cls, position: ArrayLike, direction: ArrayLike) -> "Pose":
        """Make the pose of a level body that looks along a direction.

        The half-angle formulas give the quaternion by square roots, without an angle, and so with
        the same bits on every processor.

        Args:
            position: (3,), metres, in the world.
            direction: (2,), x and y in the world, of any length.

        Returns:
            The pose.

        Raises:
            ValueError: If the direction has no length, or an infinite one.
        """
        x, y = (float(part) for part in np.asarray(direction, float))
        length = math.sqrt(x * x + y * y)
        if not 0.0 < length < math.inf:
            raise ValueError(f"pose: direction = [{x:g}, {y:g}], expected a finite length above 0")
        # cos²(yaw/2) = (1 + cos yaw) / 2. The larger of sine and cosine is taken by the root, the
        # other by sin yaw = 2 sin cos, so that no digits cancel
        large = math.sqrt(0.5 + 0.5 * abs(x) / length)
        small = 0.5 * y / length / large
        w, z = (large, small) if x >= 0.0 else (abs(small), math.copysign(large, y))
        return cls(np.asarray(position, float), np.array([w, 0.0, 0.0, z]))

    def to_body(self, points: Floats) -> Floats:
        """Transform points (..., 3) from the world, metres, to the body's frame."""
        return rotate(self.back, points - self.position)

    @property
    def back(self) -> Floats:
        """The inverse rotation as a quaternion, (4,): from the world's axes to the body's."""
        return self.quaternion * (1.0, -1.0, -1.0, -1.0)


def chained(parent: Pose, child: Pose) -> Pose:
    """Compose two poses.

    Args:
        parent: A frame's pose in the world.
        child: A pose in that frame.

    Returns:
        The child's pose in the world.
    """
    import mujoco  # here, since reading datasets must not load it

    turned = np.empty(4)
    mujoco.mju_mulQuat(turned, parent.quaternion, child.quaternion)
    position = parent.position + rotate(parent.quaternion, child.position)
    # products of unit quaternions drift from length 1 by rounding
    return Pose(position, unit(turned))


def unit(quaternion: Floats) -> Floats:
    """Scale a quaternion (4,) to length 1."""
    return quaternion / np.sqrt((quaternion**2).sum())


def rotate(quaternion: ArrayLike, vectors: ArrayLike) -> Floats:
    """Rotate vectors.

    Args:
        quaternion: (4,), w x y z, of length 1.
        vectors: (..., 3).

    Returns:
        The rotated vectors, (..., 3).

    Raises:
        ValueError: If vectors have another shape, such as points with an intensity.
    """
    array = np.ascontiguousarray(vectors, float).view()
    if array.shape[-1:] != (3,):
        raise ValueError(f"vectors of shape {array.shape}, expected (..., 3)")
    # the kernel is compiled once, for what may be written to and for what may not
    array.setflags(write=False)
    turned = np.empty(array.shape)
    _rotate(np.array(quaternion, float), array.reshape(-1, 3), turned.reshape(-1, 3))
    return turned


@kernel
def _rotate(quaternion, vectors, turned):
    """Multiply by the rotation matrix, term by term: products of BLAS differ between processors."""
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
