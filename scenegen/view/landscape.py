"""Pictures of worlds: our own rays are the camera, so what is drawn is what the sensor would meet."""

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarsim import AnalyticEngine
from lidarsim.solids.shapes import PLANE
from scenegen.view.colours import HEIGHTS, colour
from scenegen.view.oblique import EYE, RIGHT, UP, project
from scenegen.view.still import RED, add_bar, add_legend, blank, frame_box
from scenegen.world import World

PIXELS = 1000
"""Pixels across the picture."""
SUN = np.array((-0.35, -0.55, 0.9)) / np.linalg.norm((-0.35, -0.55, 0.9))


def draw_world(world: World, *, title: str, flight: NDArray[np.float64] | None = None) -> Figure:
    """A world as rays see it, from above and aside, coloured by height (planes grey), with the box in which the sensor
    flies, and a `flight` (n, 3) where one is given."""
    low, high = world.flight_bounds
    seen = see(world, low, high)
    figure = blank(9, 6.6, title)
    panel = figure.add_axes((0.01, 0.05, 0.86, 0.88))
    panel.imshow(seen[0], origin="lower", extent=seen[1], interpolation="bilinear", zorder=2)
    frame_box(panel, low, high)
    if flight is not None:
        panel.plot(*project(flight).T, color=RED, linewidth=1, zorder=6)
        panel.scatter(*project(flight).T, s=40, color=RED, edgecolors="white", linewidths=0.8, zorder=7)
        add_legend(figure, world=True)
    add_bar(figure, (0.9, 0.2, 0.016, 0.6), HEIGHTS, (low[2], high[2]), "height / m")
    return figure


def see(
    world: World, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[float, float, float, float]]:
    """Colours (rows, columns, 3) of parallel rays through the box, and where the picture lies on the paper.

    Rays begin where the eye's direction leaves the box's surroundings, and end behind it.
    """
    corners = np.array([[(low, high)[(n >> axis) & 1][axis] for axis in range(3)] for n in range(8)])
    paper = project(corners)
    (left, down), (right, up) = paper.min(axis=0), paper.max(axis=0)
    step = max(right - left, up - down) / PIXELS
    across, upward = np.arange(left, right, step) + step / 2, np.arange(down, up, step) + step / 2
    away = float((corners @ EYE).max()) + 1.0
    origins = across[None, :, None] * RIGHT + upward[:, None, None] * UP + away * EYE
    reach = away - float((corners @ EYE).min()) + 1.0
    engine = AnalyticEngine.of(world.model, world.data)
    flat = origins.reshape(-1, 3)
    hits = engine.hits(flat, np.broadcast_to(-EYE, (len(flat), 1, 3)).copy(), reach)
    points, normals, geoms = hits.points[:, 0], hits.normals[:, 0], hits.geoms[:, 0]
    with np.errstate(invalid="ignore"):
        light = 0.62 + 0.38 * np.abs(np.nan_to_num(normals @ SUN))
        shades = colour(np.nan_to_num((points[:, 2] - low[2]) / max(high[2] - low[2], 1e-9)), HEIGHTS)
    planes = world.solids.geom[world.solids.shape == PLANE]
    shades[np.isin(geoms, planes)] = 0.9
    image = np.where((geoms >= 0)[:, None], shades * light[:, None], 1.0)
    return image.clip(0, 1).reshape(*origins.shape[:2], 3), (left, right, down, up)
