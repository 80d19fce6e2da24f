"""What pictures and pages are drawn with: colours of heights, distances, errors and paths, as red,
green and blue from 0 to 255; and a parallel view from above and aside, which says where points of
the world come to lie on paper, and voxels as visible faces."""

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


CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""A face's, along the two axes that it spans."""
SHADES = (0.74, 0.86, 1.0)
"""Brightness of faces across x, y and z."""


@dataclass(frozen=True)
class View:
    """Where the eye stands, above; angles are radians, the elevation between 0 and a quarter
    turn."""

    azimuth: float = math.radians(-60)
    """Counter-clockwise from x: between x and −y."""
    elevation: float = math.radians(32)

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
        """Points (…, 3) of the world as (…, 2) on the paper, rightward and upward; lengths across
        the view are kept."""
        return np.asarray(points, float) @ np.stack([self.right, self.up], axis=1)


VIEW = View()


def visible_faces(mask: Mask, view: View) -> tuple[Ints, Ints, Floats]:
    """Faces of voxels that look towards the eye and touch no other voxel.

    Args:
        mask: The voxels (x, y, z).
        view: Where the eye stands.

    Returns:
        Corners (F, 4, 3) in voxels, each face's voxel (F, 3), and its brightness (F,), in an order
        in which later ones hide earlier ones.
    """
    padded, towards = np.pad(mask, 1), view.eye > 0
    sides = np.where(towards, 1, -1)
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
    """The edges of a box as pairs of ends: (3, 2, 3) that it hides itself, and (9, 2, 3) before
    it."""
    pairs = itertools.combinations(np.indices((2, 2, 2)).reshape(3, -1).T, 2)
    edges = np.array([pair for pair in pairs if np.ptp(pair, axis=0).sum() == 1])
    # all that lead to the farthest corner
    hidden = (edges == (view.eye < 0)).all(axis=2).any(axis=1)
    ends = np.where(edges, high, low)
    return ends[hidden], ends[~hidden]
