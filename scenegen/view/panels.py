"""The parts of pictures by matplotlib, without a screen or a GPU: dark on white, axes in metres."""

import io
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import Collection, LineCollection, PathCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from lidarsim.grid import Floats, Mask
from scenegen.base.errors import DatasetError, printable
from scenegen.view.canvas import (
    DISTANCES,
    HEIGHTS,
    INVENTED,
    MISSED,
    SENSOR,
    VIEW,
    Anchors,
    View,
    box_edges,
    colour,
    error_colours,
    rgb,
    visible_faces,
)
from scenegen.view.look import Look

INK, SOFT = "#1b1f24", "#59636e"
RED = rgb(SENSOR)
MAP = "#1560bd"
"""The colour of a map's box where another one is drawn, too."""
DPI, PAPER_DPI = 150, 400
UNREAD = "could not be read"
BESIDE, LINE = 1.15, 0.25
"""Room for a bar beside panels, and for a line of letters, inches."""
WIDE, TALL = 3.05, 2.6
"""A panel with voxels, inches."""
LEAST = 1.1
"""The narrowest panel in which letters for print have room, inches."""
SMALLER = 0.4
"""Share of their area that balls and points keep for print, where panels are small."""


def legend_columns(wide: float, marks: int) -> int:
    """Columns of a legend of so many marks below a figure, inches."""
    return min(marks, max(1, int(wide / 1.75)))


def blank(
    wide: float, tall: float, title: str, handles: Sequence[Any], dpi: int | None = None
) -> Figure:
    """A white figure, inches, with a legend of `handles` below; what is put into it finds its
    place when it is drawn."""
    figure = Figure(figsize=(wide, tall), dpi=dpi or DPI, facecolor="white", layout="compressed")
    if title:
        figure.suptitle(title, color=INK, fontsize=12)
    figure.legend(
        handles=list(handles),
        loc="outside lower center",
        ncols=legend_columns(wide, len(handles)),
        fontsize=8,
        frameon=False,
        labelcolor=INK,
        handlelength=3,
    )
    return figure


def to_bytes(figure: Figure, suffix: str) -> bytes:
    """A figure as the file that the suffix says: .png, .pdf, .svg, or .webp."""
    from matplotlib import rc_context

    file = io.BytesIO()
    # without the version of matplotlib, so that the same picture is the same file
    unsaid = {"Software": None} if suffix == ".png" else None
    with rc_context({"pdf.fonttype": 42, "svg.fonttype": "none"}):  # letters stay letters
        # the figure's own dpi: matplotlib's "figure" is the one that it began with
        figure.savefig(file, format=suffix[1:], dpi=figure.dpi, metadata=unsaid)
    return file.getvalue()


def for_paper(figure: Figure, width: float, points: float) -> None:
    """Make a figure one for print, `width` inches wide: without a title, all letters of one size,
    voxels and points as pixels fine enough for it in files that hold lines and letters as such."""
    wide, tall = figure.get_size_inches()
    figure.set_size_inches(width, tall * width / wide)
    figure.suptitle("")
    figure.set_dpi(PAPER_DPI)
    for text in figure.findobj(Text):
        text.set_fontsize(points)
    for many in figure.findobj(Collection):
        many.set_rasterized(not isinstance(many, LineCollection))
        if isinstance(many, PathCollection):
            many.set_sizes(SMALLER * many.get_sizes())


def plain(text: str) -> str:
    """`text` in one line as matplotlib shows it: a dollar sign would begin mathematics."""
    return printable(text).replace("$", r"\$")


def put_title(panel: Any, text: str) -> None:
    """The words above a panel."""
    panel.set_title(text, color=INK, fontsize=10)


def put_note(panel: Any, text: str, right: float = 0.02, up: float = 0.02) -> None:
    """Words in a panel, by default in the lower left corner, which its box leaves free."""
    panel.text(right, up, text, transform=panel.transAxes, color=SOFT, fontsize=8)


def put_ball(
    panel: Any, at: Any, *, size: float = 50, color: Any = RED, order: int = 7, marker: str = "o"
) -> None:
    """Balls, or other marks, with a white rim, at positions (2,) or (n, 2) on the paper."""
    panel.scatter(
        *np.asarray(at).T,
        s=size,
        color=color,
        zorder=order,
        marker=marker,
        edgecolors="white",
        linewidths=0.8,
    )


def put_points(
    panel: Any, points: Floats, low: float, high: float, size: float, view: View = VIEW
) -> None:
    """Points (n, 3), coloured by height from `low` to `high`, metres; near ones hide far ones."""
    points = points[np.argsort(points @ view.eye)]
    shades = colour((points[:, 2] - low) / (high - low), HEIGHTS)
    panel.scatter(*view.project(points).T, s=size, c=shades, linewidths=0, zorder=3)


def put_box(panel: Any, low: Any, high: Any) -> None:
    """A map's box, in blue, in front of what is drawn."""
    edges = VIEW.project(np.concatenate(box_edges(low, high)))
    panel.add_collection(LineCollection(edges, colors=MAP, linewidths=1.4, zorder=6))


def draw_panel(
    panel: Any,
    look: Look,
    name: str,
    title: str,
    *,
    ticks: bool,
    view: View = VIEW,
) -> None:
    """Draws `points`, or the mask `name`, and the sensor in the map's box."""
    low, high = look.corners
    put_title(panel, title)
    frame_box(panel, low, high, ticks=ticks, view=view)
    if name == "points" and look.points is not None:
        put_points(panel, look.points, low[2], high[2], 4, view)
    else:
        draw_voxels(panel, look, look.masks.get(name), view=view)
    put_ball(panel, view.project(look.position))


def draw_voxels(
    panel: Any,
    look: Look,
    mask: Mask | None,
    *,
    truth: Mask | None = None,
    view: View = VIEW,
) -> None:
    """Draws cubes where `mask` is set, coloured by height; of None, says that it could not be read.

    With a `truth`, cubes that it has and the mask lacks are drawn, too, and errors have the colours
    of `error_colours`.
    """
    if mask is None:
        put_note(panel, UNREAD, 0.35, 0.5)
        return
    corners, voxels, light = visible_faces(mask if truth is None else mask | truth, view)
    paper = view.project(look.origin + corners * look.grid.voxel_m)
    shades = colour(voxels[:, 2] / max(mask.shape[2] - 1, 1), HEIGHTS)
    if truth is not None:
        for right, deep in ((mask, MISSED), (truth, INVENTED)):
            wrong = ~right[tuple(voxels.T)]
            shades[wrong] = error_colours(deep, right, voxels[wrong])
    shades *= light[:, None]
    panel.add_collection(
        PolyCollection(paper, facecolors=shades, edgecolors=shades, linewidths=0.2, zorder=3)
    )


def frame_box(
    panel: Any,
    low: Floats,
    high: Floats,
    *,
    ticks: bool = True,
    view: View = VIEW,
) -> None:
    """Draws a box with its axes in metres, and sets the limits of `panel` around it. Ticks stand
    where they do for `VIEW`."""
    hidden, front = map(view.project, box_edges(low, high, view))
    for edges, shade, width, order in ((hidden, SOFT, 0.6, 1), (front, INK, 0.8, 5)):
        lines = LineCollection(edges, colors=shade, linewidths=width, zorder=order)
        panel.add_collection(lines)
    corners = np.concatenate([hidden, front]).reshape(-1, 2)
    span = np.ptp(corners, axis=0).max()
    if ticks:
        _put_axes(panel, low, high, 0.09 * span, view)
    room = 0.12 * span if ticks else 0.03 * span
    left, down = corners.min(axis=0) - room
    right, up = corners.max(axis=0) + room
    panel.set(xlim=(left, right), ylim=(down, up), aspect="equal")
    panel.set(xticks=[], yticks=[], frame_on=False)


def _put_axes(panel: Any, low: Any, high: Any, apart: float, view: View) -> None:
    """The name and the ends of each axis, metres, at the middle of an edge."""
    for axis, outwards in enumerate(((0.3, -1), (1, -0.6), (-1.1, 0))):
        point = np.where([axis == 1, False, False], high, low)  # y stands at the far end of x
        point[axis] = (low[axis] + high[axis]) / 2
        text = f"{'xyz'[axis]} / m\n{low[axis]:.1f} … {high[axis]:.1f}"
        at = view.project(point) + apart * np.array(outwards)
        panel.text(*at, text, ha="center", va="center", fontsize=7, color=INK, zorder=8)


def add_bar(panels: Any, anchors: Anchors, ends: tuple[float, float], label: str) -> None:
    """A colour bar beside some panels of a figure."""
    shades = LinearSegmentedColormap.from_list("", [rgb(anchor) for anchor in anchors])
    values = ScalarMappable(Normalize(*ends), shades)
    panels = np.atleast_1d(panels).ravel().tolist()
    bar = panels[0].figure.colorbar(values, ax=panels, shrink=0.7, aspect=25)
    bar.set_label(label, color=INK, fontsize=8)
    bar.ax.tick_params(labelsize=8, colors=INK)


def ball(label: str, colour: Any = RED, marker: str = "o") -> Line2D:
    """A ball, or another mark, for a legend."""
    return Line2D([], [], marker=marker, linestyle="", color=colour, label=label)


def line(label: str, colour: Any = INK, width: float = 0.8, style: Any = "-") -> Line2D:
    """A line, for a legend."""
    return Line2D([], [], color=colour, linewidth=width, linestyle=style, label=label)


def across(most: int, width: float | None) -> int:
    """How many panels stand side by side: `most`, or in a figure of a `width`, inches, as many as
    can be read."""
    return min(most, max(1, int((width - BESIDE) / LEAST))) if width else most


class Grid:
    """A figure of panels in rows and columns, with bars at its right and a legend below. Of a
    `width`, inches, that is too narrow for them, rows and columns change places, if that helps.

    Raises DatasetError where it does not.
    """

    def __init__(
        self,
        rows: int,
        columns: int,
        title: str,
        handles: Sequence[Any],
        *,
        scale: float = 1.0,
        width: float | None,
    ):
        self.turned = rows < columns and across(columns, width) < columns
        if self.turned:
            rows, columns = columns, rows
        if width is not None:
            if across(columns, width) < columns:
                raise DatasetError(
                    f"{columns} panels side by side are too narrow to be read; give a wider "
                    "--paper, or draw fewer samples or methods"
                )
            scale = (width - BESIDE) / (WIDE * columns)
        wide = width or max(scale * WIDE * columns + BESIDE, 6.5)
        lines = 2 + -(-len(handles) // legend_columns(wide, len(handles)))
        tall = (scale * TALL + (LINE if width else 0)) * rows + LINE * lines
        self.figure = blank(wide, tall, title, handles)
        bare = {"xticks": [], "yticks": [], "frame_on": False}
        self.panels = self.figure.subplots(rows, columns, squeeze=False, subplot_kw=bare)
        if self.turned:
            self.panels = self.panels.T

    def level(
        self, row: int, column: int, look: Look, level: int, tudf: Any, title: str = ""
    ) -> None:
        """Draws one level of distances `tudf` (X, Y, Z) in a panel, x right and y up, in metres of
        the world."""
        panel = self.panels[row, column]
        z = height_of(look, level)
        put_title(panel, title)
        if tudf is None:
            put_note(panel, UNREAD, 0.35, 0.5)
            return
        (left, down, _), (right, up, _) = look.corners
        shades = colour(tudf[:, :, level].T / look.grid.truncation_m, DISTANCES)
        panel.imshow(
            shades, origin="lower", extent=(left, right, down, up), interpolation="nearest"
        )
        if abs(z - look.position[2]) <= look.grid.voxel_m:
            put_ball(panel, look.position[:2])
        panel.set_frame_on(True)
        for axis, name in ((panel.xaxis, "x / m"), (panel.yaxis, "y / m")):
            axis.set_major_locator(MaxNLocator(4))
            above = f"{axis.get_label_text()}\n".lstrip()  # the name of the row
            axis.set_label_text(above + name, color=INK, fontsize=8)
        panel.tick_params(labelsize=8, colors=INK)

    def bar_of_heights(self, looks: Sequence[Look], row: int | None = None) -> None:
        """A bar beside a row, or beside all."""
        highest = max(look.grid.extent_m[2] for look in looks)
        self._bar(HEIGHTS, highest, "height in the map / m", row)

    def bar_of_distances(self, look: Look, row: int | None = None) -> None:
        """A bar beside a row, or beside all."""
        self._bar(DISTANCES, look.grid.truncation_m, "distance / m", row)

    def _bar(self, anchors: Anchors, most: float, label: str, row: int | None) -> None:
        beside = self.panels if row is None else self.panels[row]
        if self.turned and row is not None:  # one bar above the other
            middle = -(-len(beside) // 2)
            beside = self.panels.T[:middle] if row == 0 else self.panels.T[middle:]
        add_bar(beside, anchors, (0, most), label)

    def name(self, columns: Sequence[str], rows: Sequence[str]) -> None:
        """The words above the columns, and left of the rows."""
        for panel, text in zip(self.panels[0], columns, strict=True):
            self._name(panel, text, above=not self.turned)
        for row, text in enumerate(rows):
            self.name_row(row, text)

    def name_row(self, row: int, text: str) -> None:
        """The words left of a row."""
        self._name(self.panels[row, 0], text, above=self.turned)

    def _name(self, panel: Any, text: str, *, above: bool) -> None:
        if above:
            put_title(panel, plain(text))
        else:
            panel.set_ylabel(plain(text), color=INK, fontsize=9)


def at_sensor(look: Look) -> int:
    """The level of voxels just below the sensor."""
    height = math.ceil((look.position[2] - look.origin[2]) / look.grid.voxel_m) - 1
    return int(np.clip(height, 0, look.grid.shape[2] - 1))


def height_of(look: Look, level: int) -> float:
    """The height of the middle of a level of voxels in the world, metres."""
    return float(look.origin[2] + (level + 0.5) * look.grid.voxel_m)
