"""Depth cameras: one ray through the centre of every pixel of an ideal pinhole."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarsim.elementary import sin_cos
from lidarsim.limits import MOST_RAYS
from lidarsim.parameters import number
from lidarsim.sensors.device import Device


@dataclass(frozen=True, kw_only=True)
class Pinhole(Device):
    """A camera without distortion that looks forward: a `Sensor` of shape (height, width), row 0 at
    the top.

    `max_range_m` bounds the distance along a ray, not the depth. All rays are cast at once: a
    global shutter.
    """

    width: int = number(320, least=1, most=MOST_RAYS)
    """Pixels of a row."""
    height: int = number(240, least=1, most=MOST_RAYS)
    """Rows."""
    horizontal_fov_deg: float = number(90.0, least=4, most=170)
    """Angle between the left edge of the picture and the right one, degrees."""
    vertical_fov_deg: float = number(0.0, least=0, most=170)
    """Angle between the upper edge and the lower one, degrees; 0 for square pixels."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.vertical_fov_deg < 4:
            raise ValueError(
                f"vertical_fov_deg = {self.vertical_fov_deg:g}: expected degrees from 4, or 0 for "
                f"square pixels"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.height, self.width

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Zeros (height, width)."""
        return np.zeros(self.shape)

    @property
    def directions_sensor(self) -> NDArray[np.float64]:
        """See `Device.directions_sensor`."""
        wide = _tangent(self.horizontal_fov_deg / 2)
        high = (
            _tangent(self.vertical_fov_deg / 2)
            if self.vertical_fov_deg
            else wide * self.height / self.width
        )
        left = wide * (1 - (2 * np.arange(self.width) + 1) / self.width)
        up = high * (1 - (2 * np.arange(self.height) + 1) / self.height)
        rays = np.stack(np.broadcast_arrays(1.0, left, up[:, None]), axis=-1)
        return (
            rays / np.sqrt((rays[..., 0] ** 2 + rays[..., 1] ** 2) + rays[..., 2] ** 2)[..., None]
        )


def _tangent(angle_deg: float) -> float:
    sine, cosine = sin_cos(math.radians(angle_deg))
    return float(sine / cosine)
