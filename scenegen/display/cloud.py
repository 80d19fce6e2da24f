"""Pictures of what belongs to no dataset: a recorded scan, and what a network made of it."""

from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarsim import GridSpec
from scenegen.display.colours import HEIGHTS, colour
from scenegen.display.look import Look
from scenegen.display.oblique import VIEW, box_edges
from scenegen.display.still import (
    MAP,
    RED,
    add_bar,
    add_legend,
    ball,
    blank,
    draw_sample,
    frame_box,
    line,
)
from scenegen.errors import DatasetError

MOST_DRAWN = 500_000
"""The most points of a picture: more are drawn as every second, third …"""


def draw_cloud(points: NDArray[np.float64], *, title: str) -> Figure:
    """The returns among `points` (N, 3), metres, with the sensor at the origin and the usual map's
    box around it.

    Raises DatasetError where nothing returned.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise DatasetError(f"{title}: no point of it is a return")
    points = points[:: -(-len(points) // MOST_DRAWN)]
    half = np.array(GridSpec().extent_m) / 2
    low, high = np.minimum(points.min(axis=0), -half), np.maximum(points.max(axis=0), half)
    figure = blank(9, 6.6, title)
    panel = figure.add_axes((0.01, 0.05, 0.86, 0.88))
    frame_box(panel, low, high)
    points = points[np.argsort(points @ VIEW.eye)]
    shades = colour((points[:, 2] - low[2]) / (high[2] - low[2]), HEIGHTS)
    panel.scatter(
        *VIEW.project(points).T,
        s=max(0.3, min(4.0, 2e4 / len(points))),
        c=shades,
        linewidths=0,
        zorder=3,
    )
    edges = VIEW.project(np.concatenate(box_edges(-half, half)))
    panel.add_collection(LineCollection(edges, colors=MAP, linewidths=1.2, zorder=6))
    sensor: Any = VIEW.project(np.zeros(3))
    panel.scatter(*sensor, s=50, color=RED, edgecolors="white", linewidths=0.8, zorder=7)
    add_bar(figure, (0.9, 0.2, 0.016, 0.6), HEIGHTS, (low[2], high[2]), "height / m")
    size = " × ".join(f"{edge:g}" for edge in GridSpec().extent_m)
    add_legend(
        figure,
        [
            ball("sensor"),
            line(f"a map of {size} m around it", MAP, 1.2),
            line("the box of all points"),
        ],
    )
    return figure


def draw_completion(look: Look, *, title: str) -> Figure:
    """What of a scan came into its map, and what was predicted from it, over levels of the
    predicted distances."""
    return draw_sample(look, title=title, panels=("observed", "predicted"))
