"""A sensor's pattern as a picture: where its rays point, azimuth across and elevation up."""

import numpy as np
from numpy.typing import NDArray

from lidarsim import Sensor
from lidarsim.sensors.device import angles_deg
from scenegen.display.blocks import GAP_PX, PAPER, to_png

WIDE_PX, MARGIN_DEG = 640, 3.0
"""A panel's width, and what is left around the pattern."""
LEAST_PX = 60
"""A panel's least height."""
FAINT, AXIS = (222, 226, 232), (150, 158, 170)
"""Lines every 10 and every 30 degrees; the horizon and straight ahead."""
EARLY, LATE = np.array([33.0, 102.0, 172.0]), np.array([214.0, 47.0, 39.0])
"""Colours of the rays that are cast first and last."""


def draw_patterns(sensors: list[Sensor]) -> bytes:
    """A PNG with a panel for every sensor, one below the other: every ray is a dot, from blue for
    the first to red for the last in time. x is azimuth, left of the body to the left; y is
    elevation; lines stand every 10°, darker at 0°.
    """
    panels = [draw_pattern(sensor) for sensor in sensors]
    gap = np.full((GAP_PX, WIDE_PX, 3), PAPER, np.uint8)
    rows = [part for panel in panels for part in (panel, gap)][:-1]
    return to_png(np.concatenate(rows))


def draw_pattern(sensor: Sensor) -> NDArray[np.uint8]:
    """The panel (rows, `WIDE_PX`, 3) of one sensor, over the angles that its rays span."""
    elevation, azimuth = angles_deg(sensor.directions_body.reshape(-1, 3))
    left, right = min(180.0, azimuth.max() + MARGIN_DEG), max(-180.0, azimuth.min() - MARGIN_DEG)
    high, low = min(90.0, elevation.max() + MARGIN_DEG), max(-90.0, elevation.min() - MARGIN_DEG)
    scale = (WIDE_PX - 1) / (left - right)
    height = max(LEAST_PX, int((high - low) * scale) + 1)
    panel = np.full((height, WIDE_PX, 3), PAPER, np.uint8)
    for degrees in range(-180, 181, 10):
        colour = FAINT if degrees else AXIS
        row, column = round((high - degrees) * scale), round((left - degrees) * scale)
        if 0 <= row < height and high >= degrees >= low:
            panel[row] = colour
        if 0 <= column < WIDE_PX:
            panel[:, column] = colour
    times = sensor.times_s.reshape(-1)
    late = times / (times.max() or 1.0)
    rows = np.clip(np.rint((high - elevation) * scale).astype(int), 0, height - 1)
    columns = np.clip(np.rint((left - azimuth) * scale).astype(int), 0, WIDE_PX - 1)
    panel[rows, columns] = (EARLY + late[:, None] * (LATE - EARLY)).astype(np.uint8)
    return panel
