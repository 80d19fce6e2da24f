"""Common base of sensors that are sold: name, sources of figures, mount, and range limits."""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats
from lidarsim.parameters import (
    MAX_RANGE_M,
    MAX_RAYS,
    MAX_TEXT,
    MIN_RANGE_M,
    check,
    check_text,
    number,
)
from lidarsim.pose import rotate
from lidarsim.sensors import CATALOGUE, SENSORS

DESCRIPTIVE = ("name", "source", "checked", "error", "noise")
"""Fields that describe a sensor and change none of its rays."""


@dataclass(frozen=True, kw_only=True)
class Device:
    """A sensor with a mount: a `Sensor` once a subclass adds `shape`, `directions_sensor` and, if
    rays are not all cast at once, `times_s`."""

    name: str = ""
    """What it is called; the catalogue's names are taken."""
    source: str = ""
    """The documents and files that its figures come from."""
    checked: str = ""
    """What its figures were held against."""
    error: str = ""
    """How far a unit may be from them, and what is left out."""
    noise: str = ""
    """Its faults by that document, as a chain of `lidarsim.noise`: what `--noise datasheet`
    adds."""
    max_range_m: float = number(100.0, minimum=MIN_RANGE_M, maximum=MAX_RANGE_M)
    """Farthest return, metres; nothing is returned beyond."""
    min_range_m: float = number(0.0, minimum=0, maximum=MAX_RANGE_M)
    """Nearest return, metres. Clean scans hold nearer ones, too; the noise stage `near` takes them
    out."""
    pitch_deg: float = number(0.0, minimum=-90, maximum=90)
    """How far the sensor is turned nose down as a rigid body, degrees."""
    lever_arm_m: tuple[float, float, float] = number((0.0, 0.0, 0.0), minimum=-100, maximum=100)
    """Where the sensor is on the body, x y z in the body frame, metres."""

    def __post_init__(self) -> None:
        check(self)
        for item in DESCRIPTIVE:
            check_text(item, getattr(self, item))
        if self.min_range_m >= self.max_range_m:
            raise ValueError(
                f"min_range_m = {self.min_range_m:g}: expected less than max_range_m = "
                f"{self.max_range_m:g}"
            )
        if not 0 < math.prod(self.shape) <= MAX_RAYS:
            raise ValueError(
                f"{' × '.join(map(str, self.shape))} rays: expected from 1 to {MAX_RAYS}"
            )

    @property
    def shape(self) -> tuple[int, ...]:
        """How the rays are ordered.

        Raises:
            NotImplementedError: Unless a subclass defines it.
        """
        raise NotImplementedError

    @property
    def directions_sensor(self) -> Floats:
        """Unit vectors (*shape, 3) in the sensor frame: x forward, y left, z up.

        Raises:
            NotImplementedError: Unless a subclass defines it.
        """
        raise NotImplementedError

    @property
    def times_s(self) -> Floats:
        """When each ray is cast, (*shape), seconds after the scan begins; zeros unless
        overridden."""
        return np.zeros(self.shape)

    @cached_property
    def directions_body(self) -> Floats:
        """`directions_sensor` turned nose down by `pitch_deg`; the same bits on every processor."""
        return nose_down(self.directions_sensor, self.pitch_deg)

    @property
    def made_by(self) -> str:
        """The name, and the fields that differ from its defaults:
        ``velodyne-vlp-16(rate_hz=20.0)``."""
        # a sensor of the catalogue has its own defaults
        usual = SENSORS.find(self.name) if self.name in CATALOGUE else None
        changed = [
            f"{item.name}={getattr(self, item.name)!r}"
            for item in dataclasses.fields(self)
            if item.name not in DESCRIPTIVE
            and getattr(self, item.name) != (getattr(usual, item.name) if usual else item.default)
        ]
        phrase = f"{self.name or type(self).__name__.lower()}({', '.join(changed)})".removesuffix(
            "()"
        )
        return phrase if len(phrase) <= MAX_TEXT else f"{phrase[: MAX_TEXT - 3]}..."

    def __str__(self) -> str:
        tilt = f", {self.pitch_deg:g}° nose down" if self.pitch_deg else ""
        rays = " × ".join(map(str, self.shape))
        name = self.name or type(self).__name__.lower()
        return f"{rays} rays of {name}{tilt}, up to {self.max_range_m:g} m"


def nose_down(directions: Floats, pitch_deg: float) -> Floats:
    """Turn unit vectors nose down.

    Args:
        directions: (..., 3), in the sensor frame.
        pitch_deg: Rotation about y, degrees.

    Returns:
        (..., 3), in the body frame, read-only.
    """
    sin_half, cos_half = sin_cos(np.radians(pitch_deg) / 2)
    turned = rotate([float(cos_half), 0.0, float(sin_half), 0.0], directions)
    turned.setflags(write=False)
    return turned


def pointing(elevation_deg: Floats, azimuth_deg: Floats) -> Floats:
    """Compute unit vectors of angles that broadcast.

    Args:
        elevation_deg: Up from the horizon, degrees.
        azimuth_deg: From x towards y, degrees.

    Returns:
        (..., 3).
    """
    sin_e, cos_e = sin_cos(np.radians(elevation_deg))
    sin_a, cos_a = sin_cos(np.radians(azimuth_deg))
    return np.stack(np.broadcast_arrays(cos_e * cos_a, cos_e * sin_a, sin_e), axis=-1)


def angles_deg(directions: Floats) -> Floats:
    """Compute elevation and azimuth (2, ...) of vectors (..., 3), degrees, the inverse of
    `pointing`.

    They are rounded to a billionth: NumPy's arctangent has other last bits on other processors, and
    printed or drawn angles such as 11.25° must not depend on them."""
    x, y, z = np.moveaxis(np.asarray(directions), -1, 0)
    angles = np.degrees([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)])
    return np.asarray(angles.round(9) + 0.0)  # + 0.0 makes 0 of -0
