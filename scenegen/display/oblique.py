"""A parallel view from above and aside: where points of the world come to lie on paper, and voxels
as visible faces."""

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lidarsim.grid import Floats, Ints, Mask

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
