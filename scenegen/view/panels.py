"""Parts of pictures by matplotlib, without a screen or a GPU: dark on white, axes in metres."""

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
"""Colours of letters and lines, and of notes and hidden lines."""
RED = rgb(SENSOR)
MAP = "#1560bd"
"""Colour of the map's box in a picture of a world, which has another box."""
DPI, PAPER_DPI = 150, 400
"""Pixels an inch, for the screen and for print."""
UNREAD = "could not be read"
"""Note in an empty panel."""
BAR_ROOM, LINE = 1.15, 0.25
"""Width of a colour bar beside panels, and height of a line of text, inches."""
WIDE, TALL = 3.05, 2.6
"""Width and height of a panel with voxels, inches."""
MIN_PANEL = 1.1
"""Minimum width of a panel with letters for print, inches."""
SMALLER = 0.4
"""Factor for the area of balls and points in print, where panels are small."""


def legend_columns(wide: float, marks: int) -> int:
    """Return the columns of a legend below a figure.

    Args:
        wide: Width of the figure, inches.
        marks: Number of marks in the legend.
    """
    return min(marks, max(1, int(wide / 1.75)))


def blank(
    wide: float, tall: float, title: str, handles: Sequence[Any], dpi: int | None = None
) -> Figure:
    """Make a white figure with a legend below; panels are laid out when it is drawn.

    Args:
        wide: Width, inches.
        tall: Height, inches.
        title: Title, or "".
        handles: Marks of the legend.
        dpi: Pixels an inch; None: `DPI`.
    """
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
    """Render a figure.

    Args:
        figure: The figure.
        suffix: Suffix of the file: .png, .pdf, .svg or .webp.

    Returns:
        Content of the file.
    """
    from matplotlib import rc_context

    file = io.BytesIO()
    # matplotlib would write its version, and the same picture would be another file
    metadata = {"Software": None} if suffix == ".png" else None
    with rc_context({"pdf.fonttype": 42, "svg.fonttype": "none"}):  # text stays text
        # not dpi="figure", which is that of the figure before `for_paper`
        figure.savefig(file, format=suffix[1:], dpi=figure.dpi, metadata=metadata)
    return file.getvalue()


def for_paper(figure: Figure, width: float, points: float) -> None:
    """Change a figure for print: no title, one size of letters, and voxels and points as pixels, so
    that vector files stay small.

    Args:
        figure: The figure.
        width: Width on paper, inches.
        points: Size of letters, points.
    """
    wide, tall = figure.get_size_inches()
    figure.set_size_inches(width, tall * width / wide)
    figure.suptitle("")
    figure.set_dpi(PAPER_DPI)
    for text in figure.findobj(Text):
        text.set_fontsize(points)  # after the size of the figure, which does not scale letters
    for many in figure.findobj(Collection):
        many.set_rasterized(not isinstance(many, LineCollection))
        if isinstance(many, PathCollection):
            many.set_sizes(SMALLER * many.get_sizes())


def plain(text: str) -> str:
    """Return a text in one line for matplotlib, in which a dollar sign would begin a formula."""
    return printable(text).replace("$", r"\$")


def put_title(panel: Any, text: str) -> None:
    """Write a title above a panel.

    Args:
        panel: The panel.
        text: The title.
    """
    panel.set_title(text, color=INK, fontsize=10)


def put_note(panel: Any, text: str, right: float = 0.02, up: float = 0.02) -> None:
    """Write a note in a panel, by default in the lower left corner, which the box leaves free.

    Args:
        panel: The panel.
        text: The note.
        right: Where it begins, as a share of the panel's width.
        up: Where it begins, as a share of the panel's height.
    """
    panel.text(right, up, text, transform=panel.transAxes, color=SOFT, fontsize=8)


def put_ball(
    panel: Any, at: Any, *, size: float = 50, color: Any = RED, order: int = 7, marker: str = "o"
) -> None:
    """Draw balls, or other marks, with a white rim.

    Args:
        panel: The panel.
        at: Positions (2,) or (n, 2) on the paper.
        size: Area, square points.
        color: Colour.
        order: Order of drawing: higher is in front.
        marker: Shape, by matplotlib's name.
    """
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
    """Draw points coloured by height; near ones hide far ones.

    Args:
        panel: The panel.
        points: Points (n, 3), metres in the world.
        low: Height of the first colour, metres.
        high: Height of the last colour, metres.
        size: Area of a point, square points.
        view: The projection.
    """
    points = points[np.argsort(points @ view.eye)]  # matplotlib draws them in this order
    shades = colour((points[:, 2] - low) / (high - low), HEIGHTS)
    panel.scatter(*view.project(points).T, s=size, c=shades, linewidths=0, zorder=3)


def put_box(panel: Any, low: Any, high: Any) -> None:
    """Draw a map's box in blue, in front of everything.

    Args:
        panel: The panel.
        low: Lower corner (3,), metres in the world.
        high: Upper corner (3,), metres in the world.
    """
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
    """Draw the returns or a mask of a sample, and the sensor, in the map's box.

    Args:
        panel: The panel.
        look: The sample.
        name: "points", or the name of a mask.
        title: Title of the panel.
        ticks: Whether axes have their ends in metres.
        view: The projection.
    """
    low, high = look.corners
    put_title(panel, title)
    frame_box(panel, low, high, ticks=ticks, view=view)
    if name == "points" and look.points is not None:
        put_points(panel, look.points, low[2], high[2], 4, view)
    else:
        draw_voxels(panel, look, look.masks.get(name), view=view)
    if look.has_sensor:
        put_ball(panel, view.project(look.position))


def draw_voxels(
    panel: Any,
    look: Look,
    mask: Mask | None,
    *,
    truth: Mask | None = None,
    view: View = VIEW,
) -> None:
    """Draw the voxels of a mask as cubes, coloured by height.

    Args:
        panel: The panel.
        look: The sample, which has the grid.
        mask: The voxels; None: the panel says that they could not be read.
        truth: True voxels; if given, missed ones are drawn, too, and errors have the colours of
            `error_colours`.
        view: The projection.
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
        # edges of the same colour hide the seams between faces
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
    """Draw a box, and set the panel's limits around it.

    Args:
        panel: The panel.
        low: Lower corner (3,), metres in the world.
        high: Upper corner (3,), metres in the world.
        ticks: Whether axes have their ends in metres. They are placed for the azimuth of `VIEW`.
        view: The projection.
    """
    hidden, front = map(view.project, box_edges(low, high, view))
    for edges, shade, width, order in ((hidden, SOFT, 0.6, 1), (front, INK, 0.8, 5)):
        lines = LineCollection(edges, colors=shade, linewidths=width, zorder=order)
        panel.add_collection(lines)
    corners = np.concatenate([hidden, front]).reshape(-1, 2)
    span = np.ptp(corners, axis=0).max()
    if ticks:
        _put_axes(panel, low, high, 0.09 * span, view)
    # room for the ends of axes, which stand outside the box
    room = 0.12 * span if ticks else 0.03 * span
    left, down = corners.min(axis=0) - room
    right, up = corners.max(axis=0) + room
    panel.set(xlim=(left, right), ylim=(down, up), aspect="equal")
    panel.set(xticks=[], yticks=[], frame_on=False)


def _put_axes(panel: Any, low: Any, high: Any, apart: float, view: View) -> None:
    """Write name and ends of each axis, metres, beside the middle of an edge."""
    for axis, outwards in enumerate(((0.3, -1), (1, -0.6), (-1.1, 0))):
        point = np.where([axis == 1, False, False], high, low)  # y stands at the far end of x
        point[axis] = (low[axis] + high[axis]) / 2
        text = f"{'xyz'[axis]} / m\n{low[axis]:.1f} … {high[axis]:.1f}"
        at = view.project(point) + apart * np.array(outwards)
        panel.text(*at, text, ha="center", va="center", fontsize=7, color=INK, zorder=8)


def add_bar(panels: Any, anchors: Anchors, ends: tuple[float, float], label: str) -> None:
    """Draw a colour bar beside panels of a figure.

    Args:
        panels: The panels.
        anchors: The colour scale.
        ends: Values of its first and its last colour.
        label: Name and unit of the values.
    """
    shades = LinearSegmentedColormap.from_list("", [rgb(anchor) for anchor in anchors])
    values = ScalarMappable(Normalize(*ends), shades)
    panels = np.atleast_1d(panels).ravel().tolist()
    bar = panels[0].figure.colorbar(values, ax=panels, shrink=0.7, aspect=25)
    bar.set_label(label, color=INK, fontsize=8)
    bar.ax.tick_params(labelsize=8, colors=INK)


def ball(label: str, colour: Any = RED, marker: str = "o") -> Line2D:
    """Make a ball, or another mark, for a legend.

    Args:
        label: Its text.
        colour: Its colour.
        marker: Its shape, by matplotlib's name.
    """
    return Line2D([], [], marker=marker, linestyle="", color=colour, label=label)


def line(label: str, colour: Any = INK, width: float = 0.8, style: Any = "-") -> Line2D:
    """Make a line for a legend.

    Args:
        label: Its text.
        colour: Its colour.
        width: Its width, points.
        style: Its dashes.
    """
    return Line2D([], [], color=colour, linewidth=width, linestyle=style, label=label)


def across(count: int, width: float | None) -> int:
    """Return how many panels fit side by side.

    Args:
        count: Maximum number of panels.
        width: Width of a figure for print, inches; None for the screen, which scrolls.
    """
    return min(count, max(1, int((width - BAR_ROOM) / MIN_PANEL))) if width else count


class Grid:
    """A figure of panels in rows and columns, with colour bars at the right and a legend below."""

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
        """Lay the figure out. If it is too narrow, rows and columns change places.

        Args:
            rows: Number of rows.
            columns: Number of columns.
            title: Title of the figure.
            handles: Marks of the legend.
            scale: Factor for the size of panels on the screen.
            width: Width for print, inches; None for the screen.

        Raises:
            DatasetError: The columns are too narrow either way.
        """
        # a row for each method, if columns would be too narrow to be read
        self.turned = rows < columns and across(columns, width) < columns
        if self.turned:
            rows, columns = columns, rows
        if width is not None:
            if across(columns, width) < columns:
                raise DatasetError(
                    f"{columns} panels side by side are too narrow to be read; give a wider "
                    "--paper, or draw fewer samples or methods"
                )
            scale = (width - BAR_ROOM) / (WIDE * columns)
        wide = width or max(scale * WIDE * columns + BAR_ROOM, 6.5)
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
        """Draw one level of distances in a panel, x right and y up, axes in metres of the world.

        Args:
            row: Row of the panel.
            column: Column of the panel.
            look: The sample, which has the grid.
            level: Index of the level along z.
            tudf: Distances (X, Y, Z), metres; None: the panel says that they could not be read.
            title: Title of the panel.
        """
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
        # the sensor is drawn only where the level passes through it
        if abs(z - look.position[2]) <= look.grid.voxel_m:
            put_ball(panel, look.position[:2])
        panel.set_frame_on(True)
        for axis, name in ((panel.xaxis, "x / m"), (panel.yaxis, "y / m")):
            axis.set_major_locator(MaxNLocator(4))
            above = f"{axis.get_label_text()}\n".lstrip()  # the name of the row
            axis.set_label_text(above + name, color=INK, fontsize=8)
        panel.tick_params(labelsize=8, colors=INK)

    def bar_of_heights(self, looks: Sequence[Look], row: int | None = None) -> None:
        """Draw the bar of heights.

        Args:
            looks: The samples.
            row: The row beside which it stands; None for all.
        """
        highest = max(look.grid.extent_m[2] for look in looks)
        self._bar(HEIGHTS, highest, "height in the map / m", row)

    def bar_of_distances(self, look: Look, row: int | None = None) -> None:
        """Draw the bar of distances.

        Args:
            look: A sample, for the truncation.
            row: The row beside which it stands; None for all.
        """
        self._bar(DISTANCES, look.grid.truncation_m, "distance / m", row)

    def _bar(self, anchors: Anchors, top: float, label: str, row: int | None) -> None:
        panels = self.panels if row is None else self.panels[row]
        if self.turned and row is not None:  # rows are columns now: bars stand one above the other
            middle = -(-len(panels) // 2)
            panels = self.panels.T[:middle] if row == 0 else self.panels.T[middle:]
        add_bar(panels, anchors, (0, top), label)

    def name(self, columns: Sequence[str], rows: Sequence[str]) -> None:
        """Name columns and rows.

        Args:
            columns: A name for each column, above it.
            rows: Names of the first rows, left of them.
        """
        for panel, text in zip(self.panels[0], columns, strict=True):
            self._name(panel, text, above=not self.turned)
        for row, text in enumerate(rows):
            self.name_row(row, text)

    def name_row(self, row: int, text: str) -> None:
        """Name a row.

        Args:
            row: Its number.
            text: The name, left of it.
        """
        self._name(self.panels[row, 0], text, above=self.turned)

    def _name(self, panel: Any, text: str, *, above: bool) -> None:
        if above:
            put_title(panel, plain(text))
        else:
            panel.set_ylabel(plain(text), color=INK, fontsize=9)


def at_sensor(look: Look) -> int:
    """Return the level of voxels that has the sensor's height, or ends there."""
    # at a boundary between levels, the lower one
    height = math.ceil((look.position[2] - look.origin[2]) / look.grid.voxel_m) - 1
    return int(np.clip(height, 0, look.grid.shape[2] - 1))


def height_of(look: Look, level: int) -> float:
    """Return the height of the centres of a level of voxels, metres in the world.

    Args:
        look: The sample, which has the grid.
        level: Index of the level along z.
    """
    return float(look.origin[2] + (level + 0.5) * look.grid.voxel_m)
