"""Colours of heights, distances, errors and paths, as red, green and blue from 0 to 255."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats, Ints, Mask

Rgb = tuple[int, int, int]
Anchors = tuple[Rgb, ...]
"""A scale: colours at equal steps, linear between them."""


def scale(text: str) -> Anchors:
    """A scale of colours as rrggbb."""
    return tuple((*bytes.fromhex(one),) for one in text.split())


HEIGHTS = scale("440154 482475 414487 355f8d 2a788e 21918c 22a884 44bf70 7ad151 bddf26 fde725")
"""Viridis at 11 places, from low to high: even to the eye, for all kinds of colour blindness."""
DISTANCES = scale("00224e 1a386f 434e6c 61656f 7d7c78 9b9476 bcae6c dec958 fee838")
"""Cividis at 9 places, as even, from dark blue at 0 to yellow at the truncation."""
SENSOR: Rgb = (214, 20, 60)
MISSED, INVENTED = (222, 30, 150), (36, 36, 36)
"""Errors of a prediction, in full from `DEEP` voxels on: a magenta and a black, which the heights
have not, and which differ in brightness, too."""
DEEP = 3
"""Voxels between an error and the nearest one that is right from which on it counts in full."""
PALE = 0.3
"""The share of its colour that an error has beside a right voxel; the rest is white."""
START, GOAL = (0, 158, 115), (255, 205, 0)
"""Ends of a path."""
PATHS = dict(zip(("tudf", "occ", "proposed"), scale("0060c8 f08c00 7a3cc8"), strict=True))
"""Colours of paths by the names of the paper's networks."""
OTHER_PATHS = scale("6e5028 0096aa 787878 b0c800")
"""Colours of other methods' paths, in turn. No colour of a legend is another one's, too."""


ON_PAGE = {
    "heights": HEIGHTS,
    "distances": DISTANCES,
    "sensor": SENSOR,
    "missed": MISSED,
    "invented": INVENTED,
    "start": START,
    "goal": GOAL,
    "deep": DEEP,
    "pale": PALE,
}
"""What the script of a page colours by."""


def path_colours(names: Sequence[str]) -> list[Rgb]:
    """A colour for each of the methods called `names`."""
    others = itertools.cycle(OTHER_PATHS)
    return [PATHS.get(name) or next(others) for name in names]


def colour(shares: NDArray[Any], anchors: Anchors) -> Floats:
    """Colours of values from 0 to 1: any shape to that shape by 3, each channel from 0 to 1."""
    at = np.linspace(0, 1, len(anchors))
    channels = np.array(anchors).T / 255
    return np.stack([np.interp(shares, at, channel) for channel in channels], axis=-1)


def rgb(colour: Rgb) -> tuple[float, ...]:
    """A colour as matplotlib takes it, each channel from 0 to 1."""
    return tuple(value / 255 for value in colour)


def error_colours(deep: Rgb, right: Mask, places: Ints) -> Floats:
    """Colours (n, 3) of errors at voxels `places` (n, 3), the paler the nearer to voxels that are
    `right`: a surface that is a voxel off is no failure."""
    from scipy.ndimage import distance_transform_edt

    share = np.ones(len(places))
    if right.any():
        away = distance_transform_edt(~right)[tuple(places.T)]
        share = PALE + (1 - PALE) * np.clip((away - 1) / (DEEP - 1), 0, 1)
    return 1 - share[:, None] * (1 - np.array(rgb(deep)))
