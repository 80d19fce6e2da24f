"""Sensors whose pattern does not repeat: two motions whose rates have no common measure. A scan is
a window in time."""

import math
from dataclasses import dataclass

import numpy as np

from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats
from lidarsim.parameters import number
from lidarsim.sensors.device import Device, pointing

HOUR_S = 3600.0
"""A window begins within the first hour of the pattern."""


@dataclass(frozen=True, kw_only=True)
class Windowed(Device):
    """Points one after the other at a steady rate, seen for a window that begins where `seed`
    says."""

    points_hz: float = number(100_000.0, least=1, most=1e8)
    """Points a second."""
    window_s: float = number(0.1, above=0, most=100)
    """How long a scan takes, seconds."""
    seed: int = number(0, least=0, most=2**31)
    """Which window of the pattern it is: another seed, another one."""
    after_s: float = number(0.0, least=0, most=1e6)
    """How long after that window this one begins, seconds: a log's scans follow each other."""

    @property
    def shape(self) -> tuple[int]:
        """(points,)."""
        return (math.floor(self.points_hz * self.window_s + 1e-6),)

    @property
    def times_s(self) -> Floats:
        """See `Sensor.times_s`."""
        return np.arange(self.shape[0]) / self.points_hz

    @property
    def _turns_begun_s(self) -> Floats:
        """The pattern's own time at every point, seconds."""
        return np.random.default_rng(self.seed).random() * HOUR_S + self.after_s + self.times_s


@dataclass(frozen=True, kw_only=True)
class Rosette(Windowed):
    """Two wedge prisms that turn before the beam (Risley), about the forward axis.

    To first order every prism deflects by a fixed angle, in the direction that it has turned to,
    and the two deflections add up: a curve of many petals between the difference and the sum of
    them (Brazeal et al. 2021, Sensors 21, 4722).
    """

    horizontal_fov_deg: float = number(40.0, above=1, most=180)
    """Angle between the outermost points to the left and to the right, degrees."""
    vertical_fov_deg: float = number(40.0, above=1, most=180)
    """The same of the highest and the lowest point, degrees."""
    first_hz: float = number(7294 / 60, least=-1e4, most=1e4)
    """Turns of the first prism a second."""
    second_hz: float = number(-4664 / 60, least=-1e4, most=1e4)
    """Turns of the second prism a second."""
    second_share: float = number(0.5, least=0, most=1)
    """How much of the deflection is the second prism's; with a half, petals reach the centre."""

    @property
    def directions_sensor(self) -> Floats:
        """See `Device.directions_sensor`."""
        time = self._turns_begun_s
        left, up = np.zeros(time.shape), np.zeros(time.shape)
        for rate, share in (
            (self.first_hz, 1 - self.second_share),
            (self.second_hz, self.second_share),
        ):
            sine, cosine = sin_cos(2 * math.pi * np.remainder(rate * time, 1.0))
            left += share * cosine
            up += share * sine
        left *= math.radians(self.horizontal_fov_deg / 2)
        up *= math.radians(self.vertical_fov_deg / 2)
        away = np.sqrt(left**2 + up**2)
        sine, cosine = sin_cos(away)
        along = np.divide(sine, away, out=np.ones(away.shape), where=away > 0)
        return np.stack([cosine, along * left, along * up], axis=-1)


@dataclass(frozen=True, kw_only=True)
class Coil(Windowed):
    """A mirror that turns about the vertical, and a beam that swings up and down at an even pace
    meanwhile."""

    lowest_deg: float = number(-10.0, least=-90, most=90)
    """Elevation of the lowest points, degrees."""
    highest_deg: float = number(50.0, least=-90, most=90)
    """Elevation of the highest points, degrees."""
    turns_hz: float = number(20.0, least=0.1, most=1e4)
    """Turns about the vertical a second."""
    swings_hz: float = number(1000 * math.sqrt(2), least=0.1, most=1e5)
    """Swings from the lowest to the highest point and back a second."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.highest_deg - self.lowest_deg < 4:
            raise ValueError(
                f"lowest_deg = {self.lowest_deg:g}, highest_deg = {self.highest_deg:g}: expected "
                "degrees, the highest 4 or more above the lowest"
            )

    @property
    def directions_sensor(self) -> Floats:
        """See `Device.directions_sensor`."""
        time = self._turns_begun_s
        swing = np.remainder(self.swings_hz * time, 1.0)
        height = np.where(swing < 0.5, 2 * swing, 2 - 2 * swing)
        elevation = self.lowest_deg + (self.highest_deg - self.lowest_deg) * height
        return pointing(elevation, 180.0 - 360.0 * np.remainder(self.turns_hz * time, 1.0))
