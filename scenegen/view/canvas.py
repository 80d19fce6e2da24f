"""Colours of pictures and pages, red, green and blue from 0 to 255.

Readers who cannot tell red from green can tell them apart: what is drawn together differs in
brightness, too.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats, Ints, Mask

Rgb = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""
Anchors = tuple[Rgb, ...]
"""A colour scale: colours at equal steps, linear between them."""


@dataclass(frozen=True)
class Paper:
    """Size of a picture."""

    width: float | None = None
    """Width in print, inches; None: for the screen, as wide as its panels need."""
    points: float = 8.0
    """Size of letters, points."""


SCREEN = Paper()
"""Pictures that are not for print."""


def scale(text: str) -> Anchors:
    """Parse a colour scale of words rrggbb."""
    return tuple((*bytes.fromhex(code),) for code in text.split())


HEIGHTS = scale("440154 482475 414487 355f8d 2a788e 21918c 22a884 44bf70 7ad151 bddf26 fde725")
"""Viridis at 11 steps, from low to high: perceptually uniform, also for colour-blind readers."""
DISTANCES = scale("00224e 1a386f 434e6c 61656f 7d7c78 9b9476 bcae6c dec958 fee838")
"""Cividis at 9 steps, from dark blue at 0 to yellow at the truncation."""
SENSOR: Rgb = (214, 20, 60)
"""The ball of the sensor: red."""
MISSED, INVENTED = (222, 30, 150), (36, 36, 36)
"""Errors of a prediction: magenta and black, which are not among the colours of heights, and differ
in brightness."""
DEEP = 3
"""Distance from the nearest correct voxel at which an error has its full colour, voxels."""
PALE = 0.3
"""Share of the colour that an error beside a correct voxel has; the rest is white."""
MOVERS, GHOSTS = (180, 0, 255), (150, 120, 225)
"""Movers, and observed voxels where nothing is any more. CIE76 ΔE to every other colour, those of
paths and classes aside, is 39 and 24 at least, with normal sight and without long, middle or short
cones (Machado et al. 2009)."""
START, GOAL = (0, 158, 115), (255, 205, 0)
"""Ends of a path."""
PATHS = dict(zip(("tudf", "occ", "proposed"), scale("1f86e0 f08c00 4f1a96"), strict=True))
"""Colours of paths by the names of the paper's networks."""
OTHER_PATHS = scale("0096aa 6e5028 b0c800 787878")
"""Colours of other methods' paths, in turn; none of them has another meaning in a legend."""
ON_PAGE = {
    "heights": HEIGHTS,
    "distances": DISTANCES,
    "sensor": SENSOR,
    "missed": MISSED,
    "invented": INVENTED,
    "movers": MOVERS,
    "ghosts": GHOSTS,
    "start": START,
    "goal": GOAL,
    "deep": DEEP,
    "pale": PALE,
}
"""Colours for the script of a page."""


def path_colours(names: Sequence[str]) -> list[Rgb]:
    """Return a colour for each method, by its name."""
    # colours repeat, so that a picture of any number of methods can be drawn
    spare = itertools.cycle(OTHER_PATHS)
    return [PATHS.get(name) or next(spare) for name in names]


def colour(shares: NDArray[Any], anchors: Anchors) -> Floats:
    """Colour values by a scale.

    Args:
        shares: Values from 0 to 1, of any shape.
        anchors: The scale.

    Returns:
        (*shape, 3): channels from 0 to 1.
    """
    at = np.linspace(0, 1, len(anchors))
    channels = np.array(anchors).T / 255
    return np.stack([np.interp(shares, at, channel) for channel in channels], axis=-1)


def rgb(colour: Rgb) -> tuple[float, ...]:
    """Return a colour for matplotlib, channels from 0 to 1."""
    return tuple(value / 255 for value in colour)


def error_colours(deep: Rgb, right: Mask, places: Ints) -> Floats:
    """Colour errors, paler near correct voxels: a surface that is one voxel off is no failure.

    Args:
        deep: Full colour of this error.
        right: (x, y, z): correct voxels.
        places: (n, 3): voxels of the errors.

    Returns:
        (n, 3): channels from 0 to 1.
    """
    from scipy.ndimage import distance_transform_edt

    share = np.ones(len(places))  # nothing is correct: every error counts in full
    if right.any():
        away = distance_transform_edt(~right)[tuple(places.T)]
        # a voxel beside a correct one is 1 away, and has the palest colour
        share = PALE + (1 - PALE) * np.clip((away - 1) / (DEEP - 1), 0, 1)
    return 1 - share[:, None] * (1 - np.array(rgb(deep)))
