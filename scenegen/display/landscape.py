"""Pictures of worlds: our own rays are the camera, so what is drawn is what the sensor would
meet."""

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarsim import AnalyticEngine
from lidarsim.solids.shapes import PLANE
from scenegen.display.colours import HEIGHTS, colour
from scenegen.display.oblique import VIEW, box_edges
from scenegen.display.still import MAP, RED, add_bar, add_legend, ball, blank, frame_box, line
from scenegen.worlds.world import World

PIXELS = 1000
"""Pixels across the picture."""
SUN = np.array((-0.35, -0.55, 0.9)) / np.linalg.norm((-0.35, -0.55, 0.9))


CUT = 0.3
"""Grey of solids where the picture cuts through them."""
PLAIN = 0.88
"""Grey of planes."""


def draw_world(
    world: World,
    *,
    title: str,
    flight: NDArray[np.float64] | None = None,
    places: NDArray[np.float64] | None = None,
    box: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> Figure:
    """What stands in the box in which the sensor flies, and below it, seen from above and aside, in
    metres.

    Walls and roofs before the box are cut away, solids at its faces are dark grey, planes light
    grey, and all else has the colour of its height. A `flight` (n, 3) is drawn as a red line with
    balls at its viewpoints; `places` (n, 3) as balls alone; a map's `box`, least and greatest
    corner, in blue.
    """
    low, high = world.flight_bounds.copy()
    bounded = world.solids.lower[np.isfinite(world.solids.lower).all(axis=1)]
    low[2] = min([low[2], *bounded[:, 2], *world.solids.triangles.reshape(-1, 3)[:, 2]])
    figure = blank(9, 6.6, title)
    panel = figure.add_axes((0.01, 0.05, 0.86, 0.88))
    image, extent = see(world, low, high)
    panel.imshow(image, origin="lower", extent=extent, zorder=2)
    frame_box(panel, low, high)
    if flight is not None:
        panel.plot(*VIEW.project(flight).T, color=RED, linewidth=1, zorder=6)
    balls = flight if flight is not None else places
    if balls is not None:
        panel.scatter(
            *VIEW.project(balls).T, s=24, color=RED, edgecolors="white", linewidths=0.6, zorder=7
        )
    if box is not None:
        edges = VIEW.project(np.concatenate(box_edges(*box)))
        panel.add_collection(LineCollection(edges, colors=MAP, linewidths=1.4, zorder=6))
    handles = [ball("viewpoints")] if balls is not None else []
    handles += [line("the map's box", MAP, 1.4)] if box is not None else []
    add_legend(figure, [*handles, line("the flight's box, down to the ground")])
    add_bar(figure, (0.9, 0.2, 0.016, 0.6), HEIGHTS, (low[2], high[2]), "height / m")
    return figure


def see(
    world: World, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[float, float, float, float]]:
    """Colours (rows, columns, 3) of parallel rays that begin where they enter the box from `low` to
    `high`, white where they miss it; and where the picture lies on the paper: left, right, down,
    up."""
    corners = np.array(
        [[(low, high)[(n >> axis) & 1][axis] for axis in range(3)] for n in range(8)]
    )
    (left, down), (right, up) = VIEW.project(corners).min(axis=0), VIEW.project(corners).max(axis=0)
    step = max(right - left, up - down) / PIXELS
    across, upward = np.meshgrid(
        np.arange(left, right, step) + step / 2, np.arange(down, up, step) + step / 2
    )
    flat = across.reshape(-1, 1) * VIEW.right + upward.reshape(-1, 1) * VIEW.up
    faces = np.stack([(low - flat) / VIEW.eye, (high - flat) / VIEW.eye])  # of the planes, eyewards
    begin, end = faces.max(axis=0).min(axis=1), faces.min(axis=0).max(axis=1)
    met = np.flatnonzero(begin > end)
    image = np.ones((len(flat), 3))
    extent = (left, right, down, up)
    if not len(met):  # a box without height
        return image.reshape(*across.shape, 3), extent
    engine = AnalyticEngine.of(world.model, world.data)
    reach = float((begin - end)[met].max()) + 1.0
    hits = engine.hits(
        flat[met] + begin[met, None] * VIEW.eye,
        np.broadcast_to(-VIEW.eye, (len(met), 1, 3)).copy(),
        reach,
    )
    seen = hits.geoms[:, 0] >= 0
    points, normals, geoms = (found[seen, 0] for found in (hits.points, hits.normals, hits.geoms))
    shades = colour((points[:, 2] - low[2]) / max(high[2] - low[2], 1e-9), HEIGHTS)
    planes = world.solids.geom[: len(world.solids.shape)][world.solids.shape == PLANE]
    shades[np.isin(geoms, planes)] = PLAIN
    shades *= 0.62 + 0.38 * np.abs(normals @ SUN)[:, None]
    shades[normals @ VIEW.eye < 0] = CUT  # the ray began inside
    image[met[seen]] = shades
    return image.reshape(*across.shape, 3), extent
