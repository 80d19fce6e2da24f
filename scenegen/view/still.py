"""Pictures of samples by matplotlib, without a screen or a GPU: dark on white, axes in metres."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from scenegen.errors import DatasetError
from scenegen.view.colours import DISTANCES, HEIGHTS, SENSOR, Anchors, colour
from scenegen.view.look import Look
from scenegen.view.oblique import EYE, box_edges, project, visible_faces

INK, SOFT = "#1b1f24", "#59636e"
RED = tuple(value / 255 for value in SENSOR)
DPI = 150
MOST_FACES = 400_000
"""The most faces of voxels in a panel: drawing these takes some ten seconds."""


def draw_sample(look: Look, *, title: str = "") -> Figure:
    """Returns, observed and occupied voxels, seen from above and aside, over three levels of the distances.

    The map's box is drawn around each, and the sensor as a red ball. What could not be read is left empty, and says so.
    Raises DatasetError as `draw_voxels`.
    """
    figure = blank(12, 7.8, title or look.name)
    for n, name in enumerate(("points", "observed", "occupancy")):
        draw_panel(figure.add_axes((0.01 + 0.305 * n, 0.5, 0.3, 0.43)), look, name)
    height = look.grid.shape[2]
    for n, level in enumerate(sorted({height // 4, max(height // 2 - 1, 0), 3 * height // 4})):
        draw_level(figure.add_axes((0.05 + 0.305 * n, 0.09, 0.25, 0.36)), look, level)
    low = look.origin[2]
    add_bar(figure, (0.935, 0.55, 0.012, 0.33), HEIGHTS, (low, low + look.grid.extent_m[2]), "height / m")
    add_bar(figure, (0.935, 0.1, 0.012, 0.34), DISTANCES, (0, look.grid.truncation_m), "to the nearest occupied / m")
    add_legend(figure)
    return figure


def draw_sheet(looks: Sequence[Look], *, title: str, columns: int = 4) -> Figure:
    """Many samples on one sheet: occupied voxels with the returns over them. Raises DatasetError as `draw_voxels`."""
    columns = min(columns, len(looks))
    rows = -(-len(looks) // columns)
    wide, tall = 3.1 * columns + 1.0, 2.5 * rows + 0.9
    figure = blank(wide, tall, title)
    for n, look in enumerate(looks):
        left, down = 3.1 * (n % columns) / wide, (2.5 * (rows - 1 - n // columns) + 0.4) / tall
        panel = figure.add_axes((left, down, 3.05 / wide, 2.25 / tall))
        draw_panel(panel, look, "occupancy", ticks=False)
        if look.points is not None:
            panel.scatter(*project(look.points).T, s=0.6, color=INK, linewidths=0, zorder=6)
        panel.set_title(look.name, color=INK, fontsize=9)
    highest = max(look.grid.extent_m[2] for look in looks)
    bar = (1 - 0.85 / wide, 0.2, 0.14 / wide, 0.6)
    add_bar(figure, bar, HEIGHTS, (0, highest), "height over the map's floor / m")
    add_legend(figure, dots="returns")
    return figure


def draw_panel(panel: Any, look: Look, name: str, *, ticks: bool = True) -> None:
    """`points`, or the mask `name`, in the map's box on the axes `panel`. Raises DatasetError as `draw_voxels`."""
    low, extent = look.origin, np.asarray(look.grid.extent_m)
    high = low + extent
    panel.set_title(name, color=INK, fontsize=10)
    frame_box(panel, low, high, ticks=ticks)
    if name == "points" and look.points is not None:
        points = look.points[np.argsort(look.points @ EYE)]
        share = (points[:, 2] - low[2]) / extent[2]
        panel.scatter(*project(points).T, s=4, c=colour(share, HEIGHTS), linewidths=0, zorder=3)
    elif name in look.masks:
        draw_voxels(panel, look, look.masks[name])
    else:
        panel.text(0.5, 0.5, "could not be read", transform=panel.transAxes, ha="center", color=SOFT)
    panel.scatter(*project(look.position), s=50, color=RED, edgecolors="white", linewidths=0.8, zorder=7)


def draw_voxels(panel: Any, look: Look, mask: NDArray[np.bool_]) -> None:
    """Cubes where `mask` is set, coloured by height. Raises DatasetError for more than a picture can hold."""
    corners, levels, light = visible_faces(mask)
    if len(levels) > MOST_FACES:
        raise DatasetError(f"{look.name}: {len(levels)} faces of voxels; a picture shows {MOST_FACES} at most")
    paper = project(look.origin + corners * look.grid.voxel_m)
    shades = colour(levels / max(mask.shape[2] - 1, 1), HEIGHTS) * light[:, None]
    panel.add_collection(PolyCollection(paper, facecolors=shades, edgecolors=shades, linewidths=0.2, zorder=3))


def draw_level(panel: Any, look: Look, level: int) -> None:
    """One level of the distances, x right and y up, in metres of the world."""
    z = look.origin[2] + (level + 0.5) * look.grid.voxel_m
    panel.set_title(f"distances at z = {z:.2f} m", color=INK, fontsize=10)
    if look.tudf is None:
        panel.text(0.5, 0.5, "could not be read", transform=panel.transAxes, ha="center", color=SOFT)
        return
    (x, y, _), (wide, deep, _) = look.origin, look.grid.extent_m
    shades = colour(look.tudf[:, :, level].T / look.grid.truncation_m, DISTANCES)
    panel.imshow(shades, origin="lower", extent=(x, x + wide, y, y + deep), interpolation="nearest")
    if abs(z - look.position[2]) <= look.grid.voxel_m:
        panel.scatter(*look.position[:2], s=50, color=RED, edgecolors="white", linewidths=0.8)
    panel.set_xlabel("x / m", color=INK, fontsize=8)
    panel.set_ylabel("y / m", color=INK, fontsize=8)
    panel.tick_params(labelsize=8, colors=INK)


def frame_box(panel: Any, low: NDArray[np.float64], high: NDArray[np.float64], *, ticks: bool = True) -> None:
    """A box with its axes in metres, and the limits of `panel` around it."""
    hidden, front = box_edges(low, high)
    panel.add_collection(LineCollection(project(hidden), colors=SOFT, linewidths=0.6, zorder=1))
    panel.add_collection(LineCollection(project(front), colors=INK, linewidths=0.8, zorder=5))
    corners = project(np.concatenate([hidden, front]).reshape(-1, 3))
    span = np.ptp(corners, axis=0).max()
    if ticks:
        x, y, z = 0, 1, 2
        edges = ((x, (low[y], low[z]), (0.3, -1)), (y, (high[x], low[z]), (1, -0.6)), (z, (low[x], low[y]), (-1.1, 0)))
        for axis, fixed, way in edges:
            place = np.insert(np.asarray(fixed, dtype=np.float64), axis, 0.0)
            way_out = 0.035 * span * np.array(way)
            marks = MaxNLocator(4, steps=[1, 2, 5, 10]).tick_values(low[axis], high[axis])
            for mark in marks[(marks >= low[axis] - 1e-9) & (marks <= high[axis] + 1e-9)]:
                place[axis] = mark
                _text(panel, project(place) + way_out, f"{mark:g}", 7)
            place[axis] = (low[axis] + high[axis]) / 2
            _text(panel, project(place) + 2.6 * way_out, f"{'xyz'[axis]} / m", 8)
    room = 0.12 * span if ticks else 0.03 * span
    panel.set_xlim(corners[:, 0].min() - room, corners[:, 0].max() + room)
    panel.set_ylim(corners[:, 1].min() - room, corners[:, 1].max() + room)
    panel.set_aspect("equal")
    panel.set_axis_off()


def to_bytes(figure: Figure, suffix: str) -> bytes:
    """A figure as the file that the suffix says: .png, .pdf, .svg, or .webp."""
    file = io.BytesIO()
    more: dict[str, Any] = {"metadata": {"Software": None}} if suffix == ".png" else {}
    figure.savefig(file, format=suffix.removeprefix("."), **more)
    return file.getvalue()


def _text(panel: Any, place: NDArray[np.float64], text: str, size: int) -> None:
    panel.text(*place, text, ha="center", va="center", fontsize=size, color=INK, zorder=8)


def blank(wide: float, tall: float, title: str) -> Figure:
    """A white figure, inches; matplotlib's own layouts would take longer than all that is drawn."""
    figure = Figure(figsize=(wide, tall), dpi=DPI, facecolor="white")
    figure.suptitle(title, color=INK, fontsize=12, y=1 - 0.12 / tall, va="top")
    return figure


def add_bar(
    figure: Figure, place: tuple[float, float, float, float], anchors: Anchors, ends: tuple[float, float], label: str
) -> None:
    """A colour bar at `place`: left, bottom, width and height as shares of the figure."""
    shades = LinearSegmentedColormap.from_list("", [tuple(np.array(one) / 255) for one in anchors])
    bar = figure.colorbar(ScalarMappable(Normalize(*ends), shades), cax=figure.add_axes(place))
    bar.set_label(label, color=INK, fontsize=8)
    bar.ax.tick_params(labelsize=8, colors=INK)


def add_legend(figure: Figure, *, ball: str = "sensor", box: str = "the map's box", dots: str = "") -> None:
    """What marks mean, at the lower end; none for a mark without a word."""
    handles = [
        Line2D([], [], marker="o", linestyle="", color=RED, label=ball),
        Line2D([], [], color=INK, linewidth=0.8, label=box),
        Line2D([], [], marker=".", linestyle="", color=INK, label=dots),
    ]
    handles = [handle for handle in handles if handle.get_label()]
    figure.legend(handles=handles, loc="lower center", ncols=3, fontsize=8, frameon=False, labelcolor=INK)
