"""Sensors that fire one beam after the other.

Spinning LiDARs have beams at fixed elevations on a turning head. Sensors with a pattern that does
not repeat have two motions whose rates have no common measure; a scan is a window in time."""

import math
from dataclasses import dataclass

import numpy as np

from lidarsim.elementary import sin_cos
from lidarsim.grid import Floats
from lidarsim.parameters import MAX_RAYS, check, number
from lidarsim.sensors.device import Device, pointing

HOUR_S = 3600.0
"""A window begins within the first hour of the pattern."""


@dataclass(frozen=True, kw_only=True)
class Windowed(Device):
    """Points one after the other at a steady rate, seen for a window that begins where `seed`
    says."""

    points_hz: float = number(100_000.0, minimum=1, maximum=1e8)
    """Points a second."""
    window_s: float = number(0.1, above=0, maximum=100)
    """How long a scan takes, seconds."""
    seed: int = number(0, minimum=0, maximum=2**31)
    """Which window of the pattern it is: another seed, another one."""
    after_s: float = number(0.0, minimum=0, maximum=1e6)
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

    horizontal_fov_deg: float = number(40.0, above=1, maximum=180)
    """Angle between the outermost points to the left and to the right, degrees."""
    vertical_fov_deg: float = number(40.0, above=1, maximum=180)
    """The same of the highest and the lowest point, degrees."""
    first_hz: float = number(7294 / 60, minimum=-1e4, maximum=1e4)
    """Turns of the first prism a second."""
    second_hz: float = number(-4664 / 60, minimum=-1e4, maximum=1e4)
    """Turns of the second prism a second."""
    second_share: float = number(0.5, minimum=0, maximum=1)
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
            # the fraction of a turn: large angles would lose digits
            sine, cosine = sin_cos(2 * math.pi * np.remainder(rate * time, 1.0))
            left += share * cosine
            up += share * sine
        left *= math.radians(self.horizontal_fov_deg / 2)
        up *= math.radians(self.vertical_fov_deg / 2)
        # the deflection's angle; its sine over it scales the offsets to a unit vector
        deflection = np.sqrt(left**2 + up**2)
        sine, cosine = sin_cos(deflection)
        along = np.divide(sine, deflection, out=np.ones(deflection.shape), where=deflection > 0)
        return np.stack([cosine, along * left, along * up], axis=-1)


@dataclass(frozen=True, kw_only=True)
class Coil(Windowed):
    """A mirror that turns about the vertical, and a beam that swings up and down at an even pace
    meanwhile."""

    lowest_deg: float = number(-10.0, minimum=-90, maximum=90)
    """Elevation of the lowest points, degrees."""
    highest_deg: float = number(50.0, minimum=-90, maximum=90)
    """Elevation of the highest points, degrees."""
    turns_hz: float = number(20.0, minimum=0.1, maximum=1e4)
    """Turns about the vertical a second."""
    swings_hz: float = number(1000 * math.sqrt(2), minimum=0.1, maximum=1e5)
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
        # a triangle wave: up in the first half, down in the second
        height = np.where(swing < 0.5, 2 * swing, 2 - 2 * swing)
        elevation = self.lowest_deg + (self.highest_deg - self.lowest_deg) * height
        return pointing(elevation, 180.0 - 360.0 * np.remainder(self.turns_hz * time, 1.0))


FINEST_DEG = 0.04
"""The least mean distance of beams, degrees: no sensor has less, but angles in radians seem to."""


@dataclass(frozen=True, kw_only=True)
class Spinning(Device):
    """Beams on a turning head: a `Sensor` of shape (beams, columns).

    Beam b of column c is fired at ``c · cycle + firing_times_s[b]`` after the scan begins. The head
    stands then at the azimuth that its rate gives, begun at the rear, and the beam points
    `azimuth_offsets_deg[b]` beside it.
    """

    elevations_deg: tuple[float, ...] = number(minimum=-90, maximum=90)
    """Elevation of every beam, degrees."""
    azimuth_offsets_deg: tuple[float, ...] = number((), minimum=-180, maximum=180)
    """How far every beam points beside the head, counter-clockwise, degrees; none for beams in one
    plane."""
    firing_times_s: tuple[float, ...] = number((), minimum=0, maximum=1)
    """When every beam fires after its column begins, seconds; none where all of a column fire at
    once."""
    columns: int = number(0, minimum=0, maximum=MAX_RAYS)
    """Columns of a turn; 0 for as many as firing cycles fit into it."""
    firing_cycle_s: float = number(0.0, minimum=0, maximum=1)
    """From one column to the next, seconds; 0 for a turn's time shared by its columns."""
    rate_hz: float = number(10.0, minimum=0.1, maximum=1000)
    """Turns a second."""
    horizontal_fov_deg: float = number(360.0, above=0, maximum=360)
    """How much of the turn is scanned, about the forward axis, degrees."""
    clockwise: bool = True
    """The sense of the turn, seen from above."""

    def __post_init__(self) -> None:
        check(self)
        beams = len(self.elevations_deg)
        if not beams:
            raise ValueError(
                "elevations_deg = []: a sensor has one beam at least; give the elevation of each, "
                "degrees"
            )
        # exactly one of the two determines the other
        if (self.columns == 0) == (self.firing_cycle_s == 0):
            raise ValueError(
                f"columns = {self.columns}, firing_cycle_s = {self.firing_cycle_s}: expected one "
                "of the two, and the other 0"
            )
        super().__post_init__()
        for name in ("azimuth_offsets_deg", "firing_times_s"):
            if (count := len(getattr(self, name))) not in (0, beams):
                raise ValueError(
                    f"{name}: {count} numbers for {beams} beams; expected one for each, or none"
                )
        directions = zip(
            self.elevations_deg, self.azimuth_offsets_deg or (0.0,) * beams, strict=True
        )
        if len(set(directions)) < beams:
            raise ValueError(
                "elevations_deg: two beams point the same way; expected different ones"
            )
        # real beams are not as dense as FINEST_DEG, but angles in radians look so
        span = max(self.elevations_deg) - min(self.elevations_deg)
        if beams > 3 and span < FINEST_DEG * (beams - 1):
            raise ValueError(
                f"elevations_deg: {beams} beams within {span:g}°; expected degrees, and these "
                f"look like radians"
            )
        if self.firing_times_s and max(self.firing_times_s) >= self.cycle_s:
            raise ValueError(
                f"firing_times_s: up to {max(self.firing_times_s):g} s, in a cycle of "
                f"{self.cycle_s:g} s; expected seconds within the cycle"
            )

    @property
    def cycle_s(self) -> float:
        """Seconds from one column to the next."""
        return self.firing_cycle_s or 1.0 / (self.rate_hz * self.columns)

    @property
    def shape(self) -> tuple[int, int]:
        """(beams, columns)."""
        columns = self.columns or 1.0 / (self.rate_hz * self.firing_cycle_s)
        return len(self.elevations_deg), math.floor(
            # + 1e-9: rounding must not cost a column
            columns * self.horizontal_fov_deg / 360.0 + 1e-9
        )

    @property
    def times_s(self) -> Floats:
        """See `Sensor.times_s`."""
        beams, columns = self.shape
        fired = np.array(self.firing_times_s or (0.0,) * beams)
        return fired[:, None] + np.arange(columns) * self.cycle_s

    @property
    def directions_sensor(self) -> Floats:
        """See `Device.directions_sensor`."""
        offsets = np.array(self.azimuth_offsets_deg or (0.0,))[:, None]
        # degrees since the scan began, centred on the forward axis
        turned = 360.0 * self.rate_hz * self.times_s - self.horizontal_fov_deg / 2
        return pointing(
            np.array(self.elevations_deg)[:, None],
            offsets + (-turned if self.clockwise else turned),
        )
