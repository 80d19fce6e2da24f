"""A small renderer: voxels as blocks, and boxes, in a parallel projection from above and aside."""

import math
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection

from lidarsim.grid import Floats, Ints, Mask

AZIMUTH, ELEVATION = math.radians(-60), math.radians(38)
"""Direction towards the eye: counter-clockwise from x, and above the horizon."""
RIGHT = np.array([-math.sin(AZIMUTH), math.cos(AZIMUTH), 0.0])
"""Unit vector to the right on the paper."""
EYE = np.array([*(math.cos(ELEVATION) * np.array([RIGHT[1], -RIGHT[0]])), math.sin(ELEVATION)])
"""Unit vector towards the eye."""
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""Corners of a face (4, 2), along the two axes that it spans."""
SHADES = np.array([0.74, 0.86, 1.0])
"""Brightness of faces across x, y and z."""
EDGE_SHADE = 0.72
"""Brightness of edges, as a share of that of their face."""
MAX_VECTORS = 15_000
"""Maximum faces or points that a vector file has as shapes; more become pixels."""


def project(points: Any) -> Floats:
    """Project points (…, 3) of the world onto the paper (…, 2), right and up; lengths across the
    view stay."""
    return np.asarray(points, float) @ np.stack([RIGHT, np.cross(EYE, RIGHT)], axis=1)


def visible_faces(mask: Mask, veil: Mask | None = None) -> tuple[Ints, Ints, Ints]:
    """Return the faces of voxels that face the eye and touch no other voxel.

    Args:
        mask: The voxels (x, y, z).
        veil: Further voxels, through which the others can be seen; None for none.

    Returns:
        Corners (F, 4, 3) in voxels, the voxel of each face (F, 3), and the axis across it (F,),
        ordered for painting: later faces hide earlier ones.
    """
    towards = EYE > 0

    def exposed(voxels: Mask, hiding: Mask) -> Mask:
        """Find the faces towards the eye that nothing covers.

        Args:
            voxels: Voxels whose faces are asked for, (X, Y, Z).
            hiding: Voxels that cover a face beside them, (X, Y, Z).

        Returns:
            (3, X, Y, Z): whether the face across each axis is seen.
        """
        # of each axis only the side towards the eye can be seen; padded, so that the map's outer
        # faces have no neighbour
        beside = [
            np.roll(np.pad(hiding, 1), -side, axis)[1:-1, 1:-1, 1:-1]
            for axis, side in enumerate(np.where(towards, 1, -1))
        ]
        return voxels & ~np.stack(beside)

    faces = exposed(mask, mask)
    if veil is not None:
        faces |= exposed(veil, mask | veil)
    axes, *places = np.nonzero(faces)
    voxels = np.stack(places, axis=1)
    order = np.argsort(voxels @ EYE, kind="stable")  # of cubes, the nearest hides the others
    axes, voxels = axes[order], voxels[order]
    quads = [np.insert(CORNERS, axis, side, axis=1) for axis, side in enumerate(towards)]
    return voxels[:, None] + np.stack(quads)[axes], voxels, axes


def draw_blocks(
    axes: Any,
    low: Floats,
    high: Floats,
    mask: Mask,
    colours: Floats,
    veil: Mask | None = None,
    edge: float = 0.2,
) -> None:
    """Draw voxels as cubes with edges; inner and hidden sides are left out.

    Args:
        axes: Axes of matplotlib, metres on the paper.
        low: Lower corner of all voxels (3,), metres.
        high: Upper corner of all voxels (3,), metres.
        mask: The voxels (X, Y, Z).
        colours: Their colours (X, Y, Z, 4): channels and opacity, from 0 to 1.
        veil: Voxels that are drawn translucent, see `visible_faces`.
        edge: Width of the edges, points.
    """
    corners, voxels, across = visible_faces(mask, veil)
    # indexing by arrays copies, so the caller's colours stay as they are
    shades = colours[tuple(voxels.T)]
    shades[:, :3] *= SHADES[across, None]
    edges = shades * [*[EDGE_SHADE] * 3, 1]
    edges[edges[:, 3] < 1, 3] = 0  # those of a veil would hide more than its faces
    axes.add_collection(
        PolyCollection(
            project(low + corners * (high - low) / mask.shape),
            facecolors=shades,
            edgecolors=edges,
            linewidths=edge,
            rasterized=len(corners) > MAX_VECTORS,
            zorder=3,
        )
    )


def draw_box(axes: Any, low: Floats, high: Floats, place: Any, colour: Any, width: float) -> None:
    """Draw the edges of a box: those behind it thin and behind all else, the others in front.

    Args:
        axes: Axes of matplotlib, metres on the paper.
        low: Lower corner (3,), metres.
        high: Upper corner (3,), metres.
        place: Function that maps points (…, 3) onto the paper (…, 2).
        colour: Colour of the edges.
        width: Width of the edges in front, points.
    """
    far = EYE < 0
    # the hidden edges are the three that meet at the corner farthest from the eye
    hidden = np.stack([np.stack([far, far ^ axis]) for axis in np.eye(3, dtype=bool)])
    front, _, _ = visible_faces(np.ones((1, 1, 1), bool))
    # `draw_blocks` paints at 3: over the hidden edges, and under those in front
    for corners, share, order in ((hidden, 0.5, 1), (front, 1, 5)):
        outline = place(low + corners * (high - low))
        style = {"facecolors": "none", "edgecolors": [colour], "linewidths": share * width}
        axes.add_collection(PolyCollection(outline, zorder=order, **style))
