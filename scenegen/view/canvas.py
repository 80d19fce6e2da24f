"""Colours and projection of pictures and pages.

Colours of heights, distances, errors and paths are red, green and blue from 0 to 255. A `View` is a
parallel projection from above and aside: it maps points to the paper, and voxels to visible faces.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Floats, Ints, Mask

Rgb = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""
Anchors = tuple[Rgb, ...]
"""A colour scale: colours at equal steps, linear between them."""


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
START, GOAL = (0, 158, 115), (255, 205, 0)
"""Ends of a path."""
PATHS = dict(zip(("tudf", "occ", "proposed"), scale("0060c8 f08c00 7a3cc8"), strict=True))
"""Colours of paths by the names of the paper's networks."""
OTHER_PATHS = scale("6e5028 0096aa 787878 b0c800")
"""Colours of other methods' paths, in turn; none of them has another meaning in a legend."""
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
"""Colours for the script of a page."""


def path_colours(names: Sequence[str]) -> list[Rgb]:
    """Return a colour for each method, by its name."""
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
        share = PALE + (1 - PALE) * np.clip((away - 1) / (DEEP - 1), 0, 1)
    return 1 - share[:, None] * (1 - np.array(rgb(deep)))


CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""Corners of a face (4, 2), along the two axes that it spans."""
SHADES = (0.74, 0.86, 1.0)
"""Brightness of faces across x, y and z."""


@dataclass(frozen=True)
class View:
    """A parallel projection, by the direction towards the eye, which is above."""

    azimuth: float = math.radians(-60)
    """Azimuth of the eye, counter-clockwise from x, radians."""
    elevation: float = math.radians(32)
    """Elevation of the eye, radians, between 0 and π/2."""

    @cached_property
    def eye(self) -> Floats:
        """Unit vector towards the eye (3,)."""
        level = math.cos(self.elevation)
        x, y = level * math.cos(self.azimuth), level * math.sin(self.azimuth)
        return np.array([x, y, math.sin(self.elevation)])

    @cached_property
    def right(self) -> Floats:
        """Unit vector to the right on the paper (3,)."""
        return np.array([-math.sin(self.azimuth), math.cos(self.azimuth), 0.0])

    @cached_property
    def up(self) -> Floats:
        """Unit vector upwards on the paper (3,)."""
        return np.cross(self.eye, self.right)

    def project(self, points: Any) -> Floats:
        """Project points (…, 3) of the world onto the paper (…, 2), right and up; lengths across
        the view stay."""
        return np.asarray(points, float) @ np.stack([self.right, self.up], axis=1)


VIEW = View()
"""The view of all pictures unless they turn."""


def visible_faces(mask: Mask, view: View) -> tuple[Ints, Ints, Floats]:
    """Return the faces of voxels that face the eye and touch no other voxel.

    Args:
        mask: The voxels (x, y, z).
        view: The projection.

    Returns:
        Corners (F, 4, 3) in voxels, the voxel of each face (F, 3), and its brightness (F,), ordered
        for painting: later faces hide earlier ones.
    """
    # padded, so that the map's outer faces have no neighbour
    padded, towards = np.pad(mask, 1), view.eye > 0
    sides = np.where(towards, 1, -1)
    # of each axis only the side towards the eye can be seen
    exposed = [
        mask & ~np.roll(padded, -side, axis)[1:-1, 1:-1, 1:-1] for axis, side in enumerate(sides)
    ]
    axes, *places = np.nonzero(exposed)
    voxels = np.stack(places, axis=1)
    order = np.argsort(voxels @ view.eye, kind="stable")  # of cubes, the nearest hides the others
    axes, voxels = axes[order], voxels[order]
    faces = [np.insert(CORNERS, axis, side, axis=1) for axis, side in enumerate(towards)]
    return voxels[:, None] + np.stack(faces)[axes], voxels, np.array(SHADES)[axes]


def box_edges(low: Floats, high: Floats, view: View = VIEW) -> tuple[Floats, Floats]:
    """Return the edges of a box.

    Args:
        low: Lower corner (3,).
        high: Upper corner (3,).
        view: The projection.

    Returns:
        Ends of the edges behind the box (3, 2, 3), and of those in front (9, 2, 3).
    """
    pairs = itertools.combinations(np.indices((2, 2, 2)).reshape(3, -1).T, 2)
    edges = np.array([pair for pair in pairs if np.ptp(pair, axis=0).sum() == 1])
    # the hidden ones are those that meet at the corner farthest from the eye
    hidden = (edges == (view.eye < 0)).all(axis=2).any(axis=1)
    ends = np.where(edges, high, low)
    return ends[hidden], ends[~hidden]
