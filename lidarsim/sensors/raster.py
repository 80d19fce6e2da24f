"""Rasters of rays: lines of equal elevation and columns of equal azimuth, and the pixels of depth
cameras."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np

from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats
from lidarsim.parameters import MAX_RANGE_M, MAX_RAYS, MIN_RANGE_M, check, number
from lidarsim.sensors.device import Device, nose_down, pointing


@dataclass(frozen=True, kw_only=True)
class Lidar:
    """A spinning LiDAR of `rows` x `columns` rays, all from one point, without lever arm to the
    body: a `Sensor`.

    Ray (r, c) has, in the sensor frame (x forward, y left, z up), elevation from ``-vertical_fov /
    2`` (r = 0) to ``+vertical_fov / 2``, both ends included, and azimuth from ``-horizontal_fov /
    2`` (c = 0) counter-clockwise; a full turn leaves its end out, a narrower field includes it. The
    counts, 60 and 30 degrees and 10 m are the paper's; the full turn and the rigid tilt are how we
    read it.
    """

    source: ClassVar[str] = (
        "The defaults (16 × 120 rays, 60°, 30° down, 10 m): Yu, Zhao, Xu, Planning-Oriented 3D "
        "Scene Completion via Coupled TUDF–Occupancy Representation Learning from Partial "
        "Observations"
    )
    error: ClassVar[str] = "The full turn and the rigid tilt are how we read the paper"
    rows: int = number(16, minimum=1, maximum=MAX_RAYS)
    """Lines, one elevation each."""
    columns: int = number(120, minimum=1, maximum=MAX_RAYS)
    """Rays a line, one azimuth each."""
    vertical_fov_deg: float = number(60.0, minimum=0, maximum=180)
    """Angle between the lowest and the highest line, degrees."""
    horizontal_fov_deg: float = number(360.0, minimum=0, maximum=360)
    """Angle swept in azimuth, degrees."""
    pitch_deg: float = number(30.0, minimum=-90, maximum=90)
    """How far the sensor looks down from the body's forward axis, degrees; see `mount`."""
    max_range_m: float = number(10.0, minimum=MIN_RANGE_M, maximum=MAX_RANGE_M)
    """Farthest return, metres; nothing is returned beyond."""
    mount: Literal["tilt", "band"] = "tilt"
    """`tilt`: the sensor is turned nose down as a rigid body, so forward rays look down and rear
    rays up. `band`: every ray's elevation is lowered by the pitch instead, the same all around."""

    def __post_init__(self) -> None:
        check(self)
        if self.rows * self.columns > MAX_RAYS:
            raise ValueError(
                f"rows = {self.rows}, columns = {self.columns}: expected {MAX_RAYS} rays at most"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows, self.columns

    @cached_property
    def directions_body(self) -> Floats:
        """Unit vectors (rows, columns, 3) in the body frame, with the same bits on every
        processor."""
        elevation = _spread(self.vertical_fov_deg, self.rows, closed=True)
        azimuth = _spread(
            self.horizontal_fov_deg, self.columns, closed=self.horizontal_fov_deg < 360.0
        )
        if self.mount == "band":
            # the pitch belongs to the elevations here, so the sensor itself is not turned
            elevation = elevation - self.pitch_deg
        directions = pointing(elevation[:, None], azimuth)
        return nose_down(directions, self.pitch_deg if self.mount == "tilt" else 0.0)

    @property
    def times_s(self) -> Floats:
        """Zeros (rows, columns): all rays are cast at once, and the body stands still meanwhile."""
        return np.zeros(self.shape)

    def __str__(self) -> str:
        mounted = "nose down" if self.mount == "tilt" else "down all around"
        return (
            f"{self.rows} × {self.columns} rays over {self.vertical_fov_deg:g}° × "
            f"{self.horizontal_fov_deg:g}°, "
            f"{self.pitch_deg:g}° {mounted}, up to {self.max_range_m:g} m"
        )


def _spread(fov_deg: float, count: int, *, closed: bool) -> Floats:
    """Space `count` angles evenly over a field of view around 0, degrees; a single one is 0."""
    if count == 1:
        return np.zeros(1)
    # a closed field has a ray at either end, a full turn one for both
    step = fov_deg / (count - 1 if closed else count)
    return -fov_deg / 2 + step * np.arange(count, dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Pinhole(Device):
    """A camera without distortion that looks forward: a `Sensor` of shape (height, width), row 0 at
    the top.

    `max_range_m` bounds the distance along a ray, not the depth. All rays are cast at once: a
    global shutter.
    """

    width: int = number(320, minimum=1, maximum=MAX_RAYS)
    """Pixels of a row."""
    height: int = number(240, minimum=1, maximum=MAX_RAYS)
    """Rows."""
    horizontal_fov_deg: float = number(90.0, minimum=4, maximum=170)
    """Angle between the left edge of the picture and the right one, degrees."""
    vertical_fov_deg: float = number(0.0, minimum=0, maximum=170)
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
    def directions_sensor(self) -> Floats:
        """See `Device.directions_sensor`."""
        # half the width and height of the picture at distance 1
        wide = _tangent(self.horizontal_fov_deg / 2)
        high = (
            _tangent(self.vertical_fov_deg / 2)
            if self.vertical_fov_deg
            else wide * self.height / self.width
        )
        # centres of pixels, from the left and from the top
        left = wide * (1 - (2 * np.arange(self.width) + 1) / self.width)
        up = high * (1 - (2 * np.arange(self.height) + 1) / self.height)
        rays = np.stack(np.broadcast_arrays(1.0, left, up[:, None]), axis=-1)
        # term by term, since sums of NumPy depend on the processor
        length2 = (rays[..., 0] ** 2 + rays[..., 1] ** 2) + rays[..., 2] ** 2
        return rays / np.sqrt(length2)[..., None]


def _tangent(angle_deg: float) -> float:
    sine, cosine = sin_cos(math.radians(angle_deg))
    return float(sine / cosine)
