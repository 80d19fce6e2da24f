"""Pictures of samples by matplotlib, without a screen or a GPU: dark on white, axes in metres."""

import io
import math
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

from scenegen.display.colours import DISTANCES, HEIGHTS, INVENTED, MISSED, SENSOR, Anchors, colour
from scenegen.display.look import Look
from scenegen.display.oblique import VIEW, View, box_edges, visible_faces
from scenegen.errors import DatasetError, printable

INK, SOFT = "#1b1f24", "#59636e"
RED = tuple(value / 255 for value in SENSOR)
MAP = "#1560bd"
"""The colour of a map's box where another one is drawn, too."""
DPI = 150
FRAMES, TURN_S, TURN_DPI = 36, 8, 90
"""Pictures of a turntable, and how long it takes to go round, seconds."""
MOST_FACES = 400_000
"""The most faces of voxels in a panel: drawing these takes some ten seconds."""


def draw_sample(
    look: Look, *, title: str = "", panels: Sequence[str] = ("points", "observed", "occupancy")
) -> Figure:
    """Returns, observed and occupied voxels, seen from above and aside, over three levels of the
    distances.

    The map's box is drawn around each, and the sensor as a red ball. What could not be read is left
    empty, and says so. Raises DatasetError as `draw_voxels`.
    """
    figure = blank(12, 7.8, title or look.name)
    for n, name in enumerate(panels):
        draw_panel(figure.add_axes((0.01 + 0.305 * n, 0.5, 0.3, 0.43)), look, name)
    height = look.grid.shape[2]
    for n, level in enumerate(sorted({height // 4, max(height // 2 - 1, 0), 3 * height // 4})):
        draw_level(figure.add_axes((0.05 + 0.305 * n, 0.09, 0.25, 0.36)), look, level)
    low = look.origin[2]
    add_bar(
        figure,
        (0.935, 0.55, 0.012, 0.33),
        HEIGHTS,
        (low, low + look.grid.extent_m[2]),
        "height / m",
    )
    add_bar(
        figure,
        (0.935, 0.1, 0.012, 0.34),
        DISTANCES,
        (0, look.grid.truncation_m),
        "to the nearest occupied / m",
    )
    add_legend(figure, [ball("sensor"), line("the map's box")])
    return figure


def draw_sheet(looks: Sequence[Look], *, title: str, columns: int = 4) -> Figure:
    """Many samples on one sheet: occupied voxels with the returns over them. Raises DatasetError as
    `draw_voxels`."""
    columns = min(columns, len(looks))
    rows = -(-len(looks) // columns)
    wide, tall = 3.1 * columns + 1.0, 2.5 * rows + 0.9
    figure = blank(wide, tall, title)
    for n, look in enumerate(looks):
        left, down = 3.1 * (n % columns) / wide, (2.5 * (rows - 1 - n // columns) + 0.4) / tall
        panel = figure.add_axes((left, down, 3.05 / wide, 2.25 / tall))
        draw_panel(panel, look, "occupancy", ticks=False)
        if look.points is not None:
            panel.scatter(*VIEW.project(look.points).T, s=0.6, color=INK, linewidths=0, zorder=6)
        panel.set_title(look.name, color=INK, fontsize=9)
    highest = max(look.grid.extent_m[2] for look in looks)
    bar = (1 - 0.85 / wide, 0.2, 0.14 / wide, 0.6)
    add_bar(figure, bar, HEIGHTS, (0, highest), "height over the map's floor / m")
    add_legend(figure, [ball("sensor"), line("the map's box"), dot("returns")])
    return figure


def draw_turn(look: Look, *, title: str, frames: int = FRAMES) -> bytes:
    """A turntable as an animated WebP: occupied voxels and returns, seen from all sides. Raises
    DatasetError as `draw_voxels`."""
    from PIL import Image

    low, high = look.origin, look.origin + look.grid.extent_m
    wide, tall = float(np.linalg.norm(look.grid.extent_m[:2])), look.grid.extent_m[2]
    reach = 0.51 * max(
        wide, (wide * math.sin(VIEW.elevation) + tall * math.cos(VIEW.elevation)) / 0.75
    )
    pictures = []
    for turn in range(frames):
        view = View(azimuth=VIEW.azimuth + 2 * math.pi * turn / frames)
        figure = blank(6.4, 4.8, title, dpi=TURN_DPI)
        draw_panel(
            panel := figure.add_axes((0.01, 0.06, 0.86, 0.86)),
            look,
            "occupancy",
            ticks=False,
            view=view,
        )
        panel.set_title("")
        if look.points is not None:
            panel.scatter(*view.project(look.points).T, s=1.2, color=INK, linewidths=0, zorder=6)
        across, upward = view.project((low + high) / 2)
        panel.set_xlim(across - reach, across + reach)  # the same in every picture
        panel.set_ylim(upward - 0.75 * reach, upward + 0.75 * reach)
        add_bar(figure, (0.88, 0.25, 0.02, 0.5), HEIGHTS, (low[2], high[2]), "height / m")
        add_legend(figure, [ball("sensor"), dot("returns"), line("the map's box")])
        pictures.append(Image.open(io.BytesIO(to_bytes(figure, ".png"))).convert("RGB"))
    file = io.BytesIO()
    pictures[0].save(
        file,
        "WEBP",
        save_all=True,
        append_images=pictures[1:],
        duration=TURN_S * 1000 // frames,
        loop=0,
        quality=72,
    )
    return file.getvalue()


def draw_panel(panel: Any, look: Look, name: str, *, ticks: bool = True, view: View = VIEW) -> None:
    """`points`, or the mask `name`, in the map's box on the axes `panel`. Raises DatasetError as
    `draw_voxels`."""
    low, extent = look.origin, np.asarray(look.grid.extent_m)
    panel.set_title(name, color=INK, fontsize=10)
    frame_box(panel, low, low + extent, ticks=ticks, view=view)
    if name == "points" and look.points is not None:
        points = look.points[np.argsort(look.points @ view.eye)]
        share = (points[:, 2] - low[2]) / extent[2]
        panel.scatter(
            *view.project(points).T, s=4, c=colour(share, HEIGHTS), linewidths=0, zorder=3
        )
    elif name in look.masks:
        draw_voxels(panel, look, look.masks[name], view=view)
    else:
        say_unread(panel)
    panel.scatter(
        *view.project(look.position), s=50, color=RED, edgecolors="white", linewidths=0.8, zorder=7
    )


def draw_voxels(
    panel: Any,
    look: Look,
    mask: NDArray[np.bool_],
    *,
    truth: NDArray[np.bool_] | None = None,
    view: View = VIEW,
) -> None:
    """Cubes where `mask` is set, coloured by height; with a `truth`, cubes that it has and the mask
    lacks, too, and errors in their own colours. Raises DatasetError for more than a picture can
    hold."""
    corners, voxels, light = visible_faces(mask if truth is None else mask | truth, view)
    if len(voxels) > MOST_FACES:
        raise DatasetError(
            f"{look.name}: {len(voxels)} faces of voxels; a picture shows {MOST_FACES} at most"
        )
    paper = view.project(look.origin + corners * look.grid.voxel_m)
    shades = colour(voxels[:, 2] / max(mask.shape[2] - 1, 1), HEIGHTS)
    if truth is not None:
        at = tuple(voxels.T)
        shades[~mask[at]], shades[~truth[at]] = np.array(MISSED) / 255, np.array(INVENTED) / 255
    shades *= light[:, None]
    panel.add_collection(
        PolyCollection(paper, facecolors=shades, edgecolors=shades, linewidths=0.2, zorder=3)
    )


def say_unread(panel: Any) -> None:
    """Say in a panel that what belongs there could not be read."""
    panel.text(0.5, 0.5, "could not be read", transform=panel.transAxes, ha="center", color=SOFT)


def draw_level(panel: Any, look: Look, level: int, tudf: NDArray[np.float32] | None = None) -> None:
    """One level of the distances `tudf`, the truth's unless given, x right and y up, in metres of
    the world."""
    z = look.origin[2] + (level + 0.5) * look.grid.voxel_m
    panel.set_title(f"distances at z = {z:.2f} m", color=INK, fontsize=10)
    tudf = look.tudf if tudf is None else tudf
    if tudf is None:
        say_unread(panel)
        return
    (x, y, _), (wide, deep, _) = look.origin, look.grid.extent_m
    shades = colour(tudf[:, :, level].T / look.grid.truncation_m, DISTANCES)
    panel.imshow(shades, origin="lower", extent=(x, x + wide, y, y + deep), interpolation="nearest")
    if abs(z - look.position[2]) <= look.grid.voxel_m:
        panel.scatter(*look.position[:2], s=50, color=RED, edgecolors="white", linewidths=0.8)
    panel.set_xlabel("x / m", color=INK, fontsize=8)
    panel.set_ylabel("y / m", color=INK, fontsize=8)
    panel.tick_params(labelsize=8, colors=INK)


def frame_box(
    panel: Any,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    *,
    ticks: bool = True,
    view: View = VIEW,
) -> None:
    """A box with its axes in metres, and the limits of `panel` around it. Ticks stand where they do
    for `VIEW`."""
    hidden, front = box_edges(low, high, view)
    panel.add_collection(
        LineCollection(view.project(hidden), colors=SOFT, linewidths=0.6, zorder=1)
    )
    panel.add_collection(LineCollection(view.project(front), colors=INK, linewidths=0.8, zorder=5))
    corners = view.project(np.concatenate([hidden, front]).reshape(-1, 3))
    span = np.ptp(corners, axis=0).max()
    if ticks:
        x, y, z = 0, 1, 2
        edges = (
            (x, (low[y], low[z]), (0.3, -1)),
            (y, (high[x], low[z]), (1, -0.6)),
            (z, (low[x], low[y]), (-1.1, 0)),
        )
        for axis, fixed, way in edges:
            place = np.insert(np.asarray(fixed, dtype=np.float64), axis, 0.0)
            way_out = 0.035 * span * np.array(way)
            marks = MaxNLocator(4, steps=[1, 2, 5, 10]).tick_values(low[axis], high[axis])
            for mark in marks[(marks >= low[axis] - 1e-9) & (marks <= high[axis] + 1e-9)]:
                place[axis] = mark
                _text(panel, view.project(place) + way_out, f"{mark:g}", 7)
            place[axis] = (low[axis] + high[axis]) / 2
            _text(panel, view.project(place) + 2.6 * way_out, f"{'xyz'[axis]} / m", 8)
    room = 0.12 * span if ticks else 0.03 * span
    panel.set_xlim(corners[:, 0].min() - room, corners[:, 0].max() + room)
    panel.set_ylim(corners[:, 1].min() - room, corners[:, 1].max() + room)
    panel.set_aspect("equal")
    panel.set_axis_off()


def plain(text: str) -> str:
    """`text` in one line as matplotlib shows it: a dollar sign would begin mathematics."""
    return printable(text).replace("$", r"\$")


def to_bytes(figure: Figure, suffix: str) -> bytes:
    """A figure as the file that the suffix says: .png, .pdf, .svg, or .webp."""
    file = io.BytesIO()
    more: dict[str, Any] = {"metadata": {"Software": None}} if suffix == ".png" else {}
    figure.savefig(file, format=suffix.removeprefix("."), **more)
    return file.getvalue()


def _text(panel: Any, place: NDArray[np.float64], text: str, size: int) -> None:
    panel.text(*place, text, ha="center", va="center", fontsize=size, color=INK, zorder=8)


def blank(wide: float, tall: float, title: str, dpi: int | None = None) -> Figure:
    """A white figure, inches; matplotlib's own layouts would take longer than all that is drawn."""
    figure = Figure(figsize=(wide, tall), dpi=dpi or DPI, facecolor="white")
    figure.suptitle(title, color=INK, fontsize=12, y=1 - 0.12 / tall, va="top")
    return figure


def add_bar(
    figure: Figure,
    place: tuple[float, float, float, float],
    anchors: Anchors,
    ends: tuple[float, float],
    label: str,
) -> None:
    """A colour bar at `place`: left, bottom, width and height as shares of the figure."""
    shades = LinearSegmentedColormap.from_list("", [tuple(np.array(one) / 255) for one in anchors])
    bar = figure.colorbar(ScalarMappable(Normalize(*ends), shades), cax=figure.add_axes(place))
    bar.set_label(label, color=INK, fontsize=8)
    bar.ax.tick_params(labelsize=8, colors=INK)


def ball(label: str, colour: Any = RED) -> Line2D:
    """A ball, for a legend."""
    return Line2D([], [], marker="o", linestyle="", color=colour, label=label)


def dot(label: str) -> Line2D:
    """A dot, for a legend."""
    return Line2D([], [], marker=".", linestyle="", color=INK, label=label)


def line(label: str, colour: Any = INK, width: float = 0.8, style: Any = "-") -> Line2D:
    """A line, for a legend."""
    return Line2D([], [], color=colour, linewidth=width, linestyle=style, label=label)


def add_legend(figure: Figure, handles: Sequence[Any]) -> None:
    """What marks mean, at the lower end."""
    looks_so: dict[str, Any] = {
        "fontsize": 8,
        "frameon": False,
        "labelcolor": INK,
        "handlelength": 3,
    }
    fit = max(1, int(figure.get_size_inches()[0] / 1.4))  # in a row
    figure.legend(
        handles=list(handles), loc="lower center", ncols=min(len(handles), fit), **looks_so
    )
