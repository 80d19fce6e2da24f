"""A parallel view from above and aside: where points of the world come to lie on paper, and voxels as visible faces."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

AZIMUTH_RAD, ELEVATION_RAD = math.radians(-60), math.radians(32)
"""Where the eye stands: between x and −y, above."""
EYE = np.array(
    [
        math.cos(ELEVATION_RAD) * math.cos(AZIMUTH_RAD),
        math.cos(ELEVATION_RAD) * math.sin(AZIMUTH_RAD),
        math.sin(ELEVATION_RAD),
    ]
)
"""Unit vector towards the eye (3,)."""
RIGHT = np.array([-math.sin(AZIMUTH_RAD), math.cos(AZIMUTH_RAD), 0.0])
UP = np.cross(EYE, RIGHT)
FACES = (
    ((0, 1), np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]]), 0.74),
    ((1, -1), np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]), 0.86),
    ((2, 1), np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]), 1.0),
)
"""The three faces of a cube that the eye sees: axis and side, corners, and brightness."""


def project(points: Any) -> NDArray[np.float64]:
    """Points (…, 3) of the world as (…, 2) on the paper, rightward and upward; lengths across the view are kept."""
    return np.asarray(points, dtype=np.float64) @ np.stack([RIGHT, UP], axis=1)


def visible_faces(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Faces of the voxels of `mask` (x, y, z) that look towards the eye and touch no other voxel: corners (F, 4, 3) in
    voxels, each face's level z (F,), and its brightness (F,), in an order in which later ones hide earlier ones."""
    corners, levels, light, order = [], [], [], []
    padded = np.pad(mask, 1)
    for number, ((axis, side), shape, brightness) in enumerate(FACES):
        open_side = ~np.roll(padded, -side, axis=axis)[1:-1, 1:-1, 1:-1]
        places = np.argwhere(mask & open_side)
        corners.append(places[:, None, :] + shape)
        levels.append(places[:, 2])
        light.append(np.full(len(places), brightness))
        # rows of cubes, from the farthest to the nearest: x rises, y falls, z rises
        far = (places[:, 0] * mask.shape[1] + mask.shape[1] - 1 - places[:, 1]) * mask.shape[2] + places[:, 2]
        order.append(3 * far + number)
    nearest_last = np.argsort(np.concatenate(order), kind="stable")
    return (
        np.concatenate(corners)[nearest_last],
        np.concatenate(levels)[nearest_last],
        np.concatenate(light)[nearest_last],
    )


def box_edges(low: Any, high: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The edges of a box, (3, 2, 3) that it hides itself, and (9, 2, 3) before it."""
    low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    hidden, front = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    for axis in range(3):
        others = [n for n in range(3) if n != axis]
        for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
            ends = np.stack([low, low])
            ends[1, axis] = high[axis]
            for other, side in zip(others, corner, strict=True):
                ends[:, other] = (low, high)[side][other]
            away = all((side == 1) == (EYE[other] < 0) for other, side in zip(others, corner, strict=True))
            (hidden if away else front).append(ends)
    return np.array(hidden), np.array(front)
