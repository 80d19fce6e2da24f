"""Colours of heights and of distances, as a few anchors between which they are linear."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Anchors = tuple[tuple[int, int, int], ...]

HEIGHTS: Anchors = (
    *((48, 18, 59), (65, 70, 172), (71, 118, 238), (58, 163, 252), (27, 208, 213)),
    *((37, 236, 167), (97, 252, 108), (164, 252, 60), (210, 233, 53), (244, 199, 58)),
    *((254, 155, 45), (243, 99, 21), (218, 57, 7), (178, 26, 1), (122, 4, 3)),
)
"""Turbo at 15 places, from low to high; within 9 of 255 of it everywhere."""
DISTANCES: Anchors = ((33, 60, 160), (104, 160, 220), (246, 244, 224), (238, 140, 70), (178, 16, 36))
"""From blue at 0 to red at the truncation, over a light middle: people who confuse red and green tell these apart."""
SENSOR = (214, 20, 60)
MISSED, INVENTED = (222, 30, 150), (36, 36, 36)
"""Errors of a prediction: a magenta and a black, which Turbo has not, and which differ in brightness, too."""


def colour(shares: NDArray[Any], anchors: Anchors) -> NDArray[np.float64]:
    """Colours of values from 0 to 1: any shape to that shape by 3, each channel from 0 to 1."""
    at = np.linspace(0, 1, len(anchors))
    return np.stack([np.interp(shares, at, np.array(anchors)[:, n] / 255) for n in range(3)], axis=-1)
