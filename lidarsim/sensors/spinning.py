"""Spinning LiDARs: beams at fixed elevations on a head that turns, each fired at its own moment."""

import math
from dataclasses import dataclass

import numpy as np

from lidarsim.grid import Floats
from lidarsim.parameters import MOST_RAYS, check, number
from lidarsim.sensors.device import Device, pointing

FINEST_DEG = 0.04
"""Beams of no sensor that is sold stand closer on average; angles given in radians seem to."""


@dataclass(frozen=True, kw_only=True)
class Spinning(Device):
    """Beams on a turning head: a `Sensor` of shape (beams, columns).

    Beam b of column c is fired at ``c · cycle + firing_times_s[b]`` after the scan begins. The head
    stands then at the azimuth that its rate gives, begun at the rear, and the beam points
    `azimuth_offsets_deg[b]` beside it.
    """

    elevations_deg: tuple[float, ...] = number(least=-90, most=90)
    """Elevation of every beam, degrees."""
    azimuth_offsets_deg: tuple[float, ...] = number((), least=-180, most=180)
    """How far every beam points beside the head, counter-clockwise, degrees; none for beams in one
    plane."""
    firing_times_s: tuple[float, ...] = number((), least=0, most=1)
    """When every beam fires after its column begins, seconds; none where all of a column fire at
    once."""
    columns: int = number(0, least=0, most=MOST_RAYS)
    """Columns of a turn; 0 for as many as firing cycles fit into it."""
    firing_cycle_s: float = number(0.0, least=0, most=1)
    """From one column to the next, seconds; 0 for a turn's time shared by its columns."""
    rate_hz: float = number(10.0, least=0.1, most=1000)
    """Turns a second."""
    horizontal_fov_deg: float = number(360.0, above=0, most=360)
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
        ways = zip(self.elevations_deg, self.azimuth_offsets_deg or (0.0,) * beams, strict=True)
        if len(set(ways)) < beams:
            raise ValueError(
                "elevations_deg: two beams point the same way; expected different ones"
            )
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
        turned = 360.0 * self.rate_hz * self.times_s - self.horizontal_fov_deg / 2
        return pointing(
            np.array(self.elevations_deg)[:, None],
            offsets + (-turned if self.clockwise else turned),
        )
