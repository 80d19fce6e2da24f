"""Colours of heights, distances, errors and paths, as red, green and blue from 0 to 255."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Rgb = tuple[int, int, int]
Anchors = tuple[Rgb, ...]
"""A scale: colours at equal steps, linear between them."""

HEIGHTS: Anchors = (
    *((48, 18, 59), (65, 70, 172), (71, 118, 238), (58, 163, 252), (27, 208, 213)),
    *((37, 236, 167), (97, 252, 108), (164, 252, 60), (210, 233, 53), (244, 199, 58)),
    *((254, 155, 45), (243, 99, 21), (218, 57, 7), (178, 26, 1), (122, 4, 3)),
)
"""Turbo at 15 places, from low to high; within 9 of 255 of it everywhere."""
DISTANCES: Anchors = (
    *((33, 60, 160), (104, 160, 220), (246, 244, 224), (238, 140, 70), (178, 16, 36)),
)
"""From blue at 0 to red at the truncation, over a light middle: people who confuse red and green
tell these apart."""
SENSOR: Rgb = (214, 20, 60)
MISSED, INVENTED = (222, 30, 150), (36, 36, 36)
"""Errors of a prediction: a magenta and a black, which Turbo has not, and which differ in
brightness, too."""
START, GOAL = (0, 128, 96), (214, 20, 60)
"""Ends of a path, as in the paper."""
PATHS = {"tudf": (0, 96, 200), "occ": (240, 140, 0), "proposed": (214, 20, 60)}
"""Colours of paths by the names of the paper's networks, as in its figures."""
OTHER_PATHS = ((0, 140, 90), (130, 60, 170), (110, 80, 40), (0, 150, 170))
"""Colours of other methods' paths, the first of them green, in turn."""


def path_colours(names: Sequence[str]) -> list[Rgb]:
    """A colour for each of the methods called `names`."""
    others = [name for name in names if name not in PATHS]
    return [PATHS.get(name) or OTHER_PATHS[others.index(name) % len(OTHER_PATHS)] for name in names]


def colour(shares: NDArray[Any], anchors: Anchors) -> NDArray[np.float64]:
    """Colours of values from 0 to 1: any shape to that shape by 3, each channel from 0 to 1."""
    at = np.linspace(0, 1, len(anchors))
    channels = np.array(anchors).T / 255
    return np.stack([np.interp(shares, at, channel) for channel in channels], axis=-1)


def rgb(colour: Rgb) -> tuple[float, ...]:
    """A colour as matplotlib takes it, each channel from 0 to 1."""
    return tuple(value / 255 for value in colour)
