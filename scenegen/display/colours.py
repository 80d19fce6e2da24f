"""Colours of heights, distances, errors and paths, as red, green and blue from 0 to 255."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Rgb = tuple[int, int, int]
Anchors = tuple[Rgb, ...]
"""A scale: colours at equal steps, linear between them."""


def scale(text: str) -> Anchors:
    """A scale of colours as #rrggbb."""
    red, green, blue = ([int(one[at : at + 2], 16) for one in text.split()] for at in (1, 3, 5))
    return tuple(zip(red, green, blue, strict=True))


HEIGHTS = scale(
    """#30123b #4146ac #4776ee #3aa3fc #1bd0d5 #25eca7 #61fc6c #a4fc3c
    #d2e935 #f4c73a #fe9b2d #f36315 #da3907 #b21a01 #7a0403"""
)
"""Turbo at 15 places, from low to high; within 9 of 255 of it everywhere."""
DISTANCES = scale("#213ca0 #68a0dc #f6f4e0 #ee8c46 #b21024")
"""From blue at 0 to red at the truncation, over a light middle: people who confuse red and green
tell these apart."""
SENSOR: Rgb = (214, 20, 60)
MISSED, INVENTED = (222, 30, 150), (36, 36, 36)
"""Errors of a prediction: a magenta and a black, which Turbo has not, and which differ in
brightness, too."""
START, GOAL = (0, 128, 96), SENSOR
"""Ends of a path, as in the paper."""
PATHS = dict(zip(("tudf", "occ", "proposed"), scale("#0060c8 #f08c00 #d6143c"), strict=True))
"""Colours of paths by the names of the paper's networks, as in its figures."""
OTHER_PATHS = scale("#008c5a #823caa #6e5028 #0096aa")
"""Colours of other methods' paths, the first of them green, in turn."""


def path_colours(names: Sequence[str]) -> list[Rgb]:
    """A colour for each of the methods called `names`."""
    others = itertools.cycle(OTHER_PATHS)
    return [PATHS.get(name) or next(others) for name in names]


def colour(shares: NDArray[Any], anchors: Anchors) -> NDArray[np.float64]:
    """Colours of values from 0 to 1: any shape to that shape by 3, each channel from 0 to 1."""
    at = np.linspace(0, 1, len(anchors))
    channels = np.array(anchors).T / 255
    return np.stack([np.interp(shares, at, channel) for channel in channels], axis=-1)


def rgb(colour: Rgb) -> tuple[float, ...]:
    """A colour as matplotlib takes it, each channel from 0 to 1."""
    return tuple(value / 255 for value in colour)
