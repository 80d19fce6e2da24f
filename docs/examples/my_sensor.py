"""A sensor of your own: a rosette."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Rosette:
    """Rays along a curve of many petals around the forward axis."""

    rays: int = 2000
    petals: float = 7.3
    half_angle_deg: float = 35.0
    scan_s: float = 0.1
    max_range_m: float = 15.0

    @property
    def shape(self):
        return (self.rays,)

    @cached_property
    def directions_body(self):
        """Unit vectors (rays, 3): x forward, y left, z up."""
        turns = np.arange(self.rays) / self.rays * 20.0
        away = math.radians(self.half_angle_deg) * np.sin(self.petals * turns)
        around = 2.0 * math.pi * turns
        return np.stack(
            [np.cos(away), np.sin(away) * np.cos(around), np.sin(away) * np.sin(around)], axis=-1
        )

    @cached_property
    def times_s(self):
        """Seconds after the scan begins, (rays,)."""
        return np.arange(self.rays) * self.scan_s / self.rays
