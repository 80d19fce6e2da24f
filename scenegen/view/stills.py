"""Pictures by matplotlib, for papers and for the screen: of samples, predictions, scans and worlds.

A picture is rows of panels. A `Panel` is data: a box, and the blocks, lines, dots or image in it.
`compose` draws all of them, with one legend, which lists what has a label.
"""

import io
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lidarsim import Sensor
from lidarsim.grid import Field, Floats, Mask
from lidarsim.sensors.device import angles_deg
from scenegen.base.errors import DatasetError, printable
from scenegen.view import blocks, canvas
from scenegen.view.blocks import project
from scenegen.view.canvas import DISTANCES, HEIGHTS, SCREEN, Anchors, Paper, colour, rgb
from scenegen.view.look import Guess, Look, PlannedPath

if TYPE_CHECKING:
    from scenegen.logs.against import SensorUnit

StyledPoints = tuple[Floats, dict[str, Any]]
"""Points (n, 3) of dots or of a line, metres in the world; and their style for matplotlib, in a
panel of `PANEL` inches."""

INK, SOFT, BLUE = "#1b1f24", "#8a939c", "#1560bd"
"""Colours of letters and lines, of hatching, and of a box within a box."""
GREYS = canvas.scale("a9b0b8 e9ecef")
"""Colours of heights behind paths: without hues, so that a path's colour stands out."""
VEIL = (0.45, 0.5, 0.55, 0.09)
"""Colour and opacity of unknown voxels."""
DPI, PAPER_DPI = 150, 400
"""Pixels an inch, for the screen and for print."""
PANEL, ALONE, MIN_PANEL, WIDE = 3.0, 7.0, 1.1, 2.0
"""Width of a panel on the screen; of one that is alone; its minimum width; and the minimum width of
one whose axes have metres, inches."""
SHEET, MAX_ACROSS = 4, 64
"""Maximum panels side by side: of one column, and of all on the screen."""
DASHES: tuple[Any, ...] = ("-", (0, (2, 1.2)), (0, (6, 1.5)), (0, (8, 1.5, 1.5, 1.5)))
"""Dashes of paths, from the last on, for readers who cannot tell the colours apart."""
OUTLINE = [0, 1, 3, 2, 0, 4, 5, 7, 6, 4, 5, 1, 3, 7, 6, 2]
"""Corners of a box in the order of a line along all its edges."""
BALL: dict[str, Any] = {"s": 36, "ec": "white", "lw": 0.7, "zorder": 9}
"""Style of balls and other marks in front of all else."""
SENSOR = BALL | {"label": "sensor", "color": rgb(canvas.SENSOR)}
HATCH: dict[str, Any] = {"fc": "#eef0f2", "ec": SOFT, "hatch": "//////"}
"""Style of unknown voxels in a level."""


def _patch(label: str, **style: Any) -> StyledPoints:
    """Make a square for the legend."""
    return np.empty((0, 3)), {"label": label, "marker": "s", "s": 60, "lw": 0.5} | style


UNKNOWN, FREE = _patch("unknown", **HATCH), _patch("free", fc="white", ec=INK)
ERRORS = [
    _patch("missed (pale: one voxel off)", color=rgb(canvas.MISSED)),
    _patch("invented (pale: one voxel off)", color=rgb(canvas.INVENTED)),
]


@dataclass(frozen=True, eq=False, kw_only=True)
class Panel:
    """A box, and what is in it."""

    low: Floats
    """Lower corner (3,), metres in the world."""
    high: Floats
    """Upper corner (3,), metres in the world."""
    mask: Mask | None = None
    """Voxels (X, Y, Z) that fill the box, drawn as blocks."""
    colours: Any = None
    """Their colours, see `draw_blocks`."""
    veil: Mask | None = None
    """Unknown voxels."""
    image: Floats | None = None
    """Colours (X, Y, 4) of a level, which is then seen from above; without opacity: unknown."""
    dots: Sequence[StyledPoints] = ()
    """Balls and points."""
    lines: Sequence[StyledPoints] = ()
    """Paths."""
    bar: tuple[str, Anchors, float, float] | None = None
    """Label of a colour bar, its scale, and the values of its ends."""
    caption: str = ""
    """Text below it."""

    def place(self, points: Any) -> Floats:
        """Place points (…, 3) on the paper (…, 2), metres."""
        return project(points) if self.image is None else np.asarray(points)[..., :2]

    def limits(self) -> Floats:
        """Return left and right, lower and upper end (2, 2) on the paper, metres."""
        corners = list(itertools.product(*zip(self.low, self.high, strict=True)))
        # paths may leave the box
        paper = self.place(np.concatenate([corners, *(points for points, _ in self.lines)]))
        room = 0.06 * np.ptp(paper, axis=0).max()
        return np.stack([paper.min(axis=0) - room, paper.max(axis=0) + room], axis=1)

    def ratio(self) -> float:
        """Return its height as a share of its width."""
        (left, right), (down, up) = self.limits()
        return float((up - down) / (right - left))

    def draw(self, axes: Any, width: float) -> None:
        """Draw it.

        Args:
            axes: Of matplotlib.
            width: Their width, inches.
        """
        limits, (low, high) = self.limits(), (self.low, self.high)
        thin = float(np.clip(width / PANEL, 0.5, 1))
        axes.set(xlim=limits[0], ylim=limits[1], xlabel=printable(self.caption), aspect="equal")
        blocks.draw_box(axes, low, high, self.place, INK, thin)
        if self.image is not None:
            (left, down), (right, up) = self.place([low, high])
            axes.fill_between((left, right), down, up, **HATCH)
            # rows of an image go along y
            image, extent = self.image.swapaxes(0, 1), (left, right, down, up)
            axes.imshow(image, origin="lower", extent=extent, zorder=2)
        if self.mask is not None:
            voxel = 72 * width * (high - low)[0] / np.ptp(limits[0]) / len(self.mask)
            edge = min(voxel / 12, 0.5)
            blocks.draw_blocks(axes, low, high, self.mask, self.colours, self.veil, edge)
        for points, style in self.lines:
            axes.plot(*self.place(points).T, **style | {"lw": thin * style["lw"], "zorder": 8})
        for points, style in self.dots:
            axes.scatter(*self.place(points).T, **style | {"s": thin**2 * style["s"]})
        if width >= WIDE:
            self._name_axes(axes)

    def _name_axes(self, axes: Any) -> None:
        """Write the ends of x, y and z along edges of the box, metres."""
        low, high = (np.round(corner, 1) + 0.0 for corner in (self.low, self.high))  # not -0.0
        starts = low, np.where([True, False, False], high, low), low
        for n, (start, offset) in enumerate(zip(starts, ((-4, -6), (6, -4), (-6, 0)), strict=True)):
            end = np.where(np.arange(3) == n, high, start)
            first, last = self.place([start, end])
            if (first != last).any():  # from above, z is a point
                rotation = math.degrees(math.atan2(*(last - first)[::-1]))
                text, middle = f"{'xyz'[n]}: {start[n]:.1f} … {end[n]:.1f} m", (first + last) / 2
                turned = {"rotation": rotation, "ha": "center", "va": "center"}
                axes.annotate(text, middle, offset, textcoords="offset points", **turned)


def style(paper: Paper) -> dict[str, Any]:
    """Return matplotlib's settings for pictures of a size."""
    return {
        "font.size": paper.points,
        **dict.fromkeys(("axes.titlesize", "axes.labelsize", "legend.fontsize"), "medium"),
        **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor"), INK),
        "axes.linewidth": 0.6,
        "text.parse_math": False,  # dollar signs in names begin no formula
        "figure.dpi": PAPER_DPI if paper.width else DPI,
        "hatch.linewidth": 0.4,
    }


def compose(
    cells: Sequence[Mapping[str, Panel | None]],
    rows: Sequence[str] = (),
    *,
    title: str = "",
    paper: Paper = SCREEN,
) -> Figure:
    """Draw panels in rows, with colour bars and one legend below them.

    Args:
        cells: Panels of each row by the names of their columns; None for an empty place.
        rows: Names beside rows.
        title: Title, which print does not have.
        paper: Size of the picture.

    Raises:
        DatasetError: The paper is too narrow, or no row has a panel.
    """
    table, columns, rows = _arrange(cells, rows, paper)
    panels = [panel for row in table for panel in row if panel]
    # panels with the same label share a bar
    bars = {panel.bar[0]: panel.bar for panel in panels if panel.bar}
    styles = [style for panel in panels for _, style in [*panel.dots, *panel.lines]]
    labels = {style["label"] for style in styles if "label" in style}
    title = "" if paper.width else title  # print has captions

    # lengths in inches, from the upper left corner
    count, em = len(table[0]), paper.points / 72
    wide = paper.width or count * max(PANEL, ALONE / count)
    left, top = 2 * em * bool(rows), 2 * em * (bool(title) + any(columns))
    width = (wide - left) / count
    heights = [width * max(panel.ratio() for panel in row if panel) for row in table]
    tops = top + np.cumsum([0, *np.add(heights, 1.8 * em)])
    ncols = max(1, int(wide / (em * (0.55 * max(map(len, labels), default=0) + 4))))
    high = tops[-1] + em * (4.5 * bool(bars) + 1.6 * -(-len(labels) // ncols) + 0.4)
    with rc_context(style(paper)):
        figure = Figure(figsize=(wide, high))

        def add_axes(x: float, y: float, width: float, height: float, **values: Any) -> Any:
            """Add axes without ticks.

            Args:
                x: Their left end, inches from the left of the figure.
                y: Their upper end, inches from its top.
                width: Their width, inches.
                height: Their height, inches.
                values: Further arguments of `Figure.add_axes`.

            Returns:
                The axes of matplotlib.
            """
            place = x / wide, 1 - (y + height) / high, width / wide, height / high
            axes = figure.add_axes(place, xticks=[], yticks=[], **values)
            axes.tick_params(labelsize=paper.points, length=2, pad=2)
            return axes

        def cut(text: str, room: float) -> str:
            """Cut a text to the letters that fit.

            Args:
                text: The text, which may be a stranger's.
                room: Room along the text, inches.

            Returns:
                One line of at least three letters, if the text has them.
            """
            return printable(text)[: max(3, int(room / (0.58 * em)))]

        figure.suptitle(cut(title, wide / 1.2), y=1 - 0.6 * em / high)
        for (n, row), (m, column) in itertools.product(enumerate(table), enumerate(columns)):
            title = cut(column, width) if n == 0 else ""
            name = cut(rows[n], heights[n]) if rows and m == 0 else ""
            x, y = left + m * width, tops[n]
            axes = add_axes(x, y, width, heights[n], title=title, ylabel=name, frame_on=False)
            if panel := row[m]:
                panel.draw(axes, width)
        for n, (label, anchors, *ends) in enumerate(bars.values()):
            room = wide / len(bars)
            length = min(2.4, 0.75 * room)
            axes = add_axes((n + 0.5) * room - length / 2, tops[-1] + 0.3 * em, length, 0.6 * em)
            shades = ListedColormap(colour(np.linspace(0, 1, 256), anchors))
            values, ticks = ScalarMappable(Normalize(*ends), shades), MaxNLocator(4)
            figure.colorbar(values, axes, orientation="horizontal", label=label, ticks=ticks)
        pairs = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in figure.axes]
        # by label: what several panels show is listed once
        marks = {label: mark for mark, label in itertools.chain(*pairs)}
        figure.legend(marks.values(), marks, loc="lower center", ncols=ncols, frameon=False)
    return figure


def _arrange(
    cells: Sequence[Mapping[str, Panel | None]], rows: Sequence[str], paper: Paper
) -> tuple[list[list[Panel | None]], list[str], list[str]]:
    """Return a table of panels, and names of its columns and rows. Columns without a panel are left
    out. A single column is dealt to rows. If the paper is too narrow, rows and columns change
    places."""
    fit = max(1, int(paper.width / MIN_PANEL)) if paper.width else MAX_ACROSS
    columns, rows = [name for name in cells[0] if any(row[name] for row in cells)], list(rows)
    if not columns:
        raise DatasetError(
            "no sample has what this picture shows; `scenegen verify` says what is damaged"
        )
    table = [[row[name] for name in columns] for row in cells]
    if len(columns) == 1:
        count = min(fit, SHEET, len(cells))
        panels = [panel for (panel,) in table] + [None] * (-len(cells) % count)
        table = [panels[n : n + count] for n in range(0, len(panels), count)]
        columns = [""] * count
    elif len(columns) > fit:
        table = [list(column) for column in zip(*table, strict=True)]
        columns, rows = rows or [""] * len(cells), columns
    if len(columns) > fit:
        raise DatasetError(
            f"{len(columns)} panels side by side are too narrow to be read; give a wider --paper, "
            "or draw fewer samples or methods"
        )
    return table, columns, rows


def to_bytes(figure: Figure, suffix: str) -> bytes:
    """Render a figure.

    Args:
        figure: The figure.
        suffix: Suffix of the file: .png, .pdf, .svg or .webp.

    Returns:
        Content of the file.
    """
    file = io.BytesIO()
    # matplotlib would write its version, and the same picture would be another file
    metadata = {"Software": None} if suffix == ".png" else None
    with rc_context({"pdf.fonttype": 42, "svg.fonttype": "none"}):  # text stays text
        figure.savefig(file, format=suffix[1:], dpi=figure.dpi, metadata=metadata)
    return file.getvalue()


def _map(
    look: Look,
    mask: Mask | None,
    *,
    truth: Mask | None = None,
    anchors: Anchors = HEIGHTS,
    dots: Sequence[StyledPoints] | None = None,
    **values: Any,
) -> Panel | None:
    """Make a panel of voxels, coloured by height; unknown ones are a veil.

    Args:
        look: The sample, which has the grid.
        mask: The voxels; None: no panel.
        truth: True voxels; if present, missed ones are drawn, too, and errors have the colours of
            `error_colours`.
        anchors: Colours of heights.
        dots: Balls and points; None: the sensor.
        values: Further values of the `Panel`.
    """
    if mask is None:
        return None
    colours = np.ones((*mask.shape, 4))
    colours[..., :3] = colour(np.linspace(0, 1, mask.shape[2]), anchors)
    dots, veil = _sensor(look) if dots is None else dots, None
    if truth is not None:
        scored = True if look.scored is None else look.scored
        for right, other, deep in ((mask, truth, canvas.MISSED), (truth, mask, canvas.INVENTED)):
            wrong = other & ~right & scored
            colours[wrong, :3] = canvas.error_colours(deep, right, np.argwhere(wrong))
        mask, dots = mask | (truth & scored), [*dots, *ERRORS]
    if look.known is not None:
        mask, veil, dots = mask & look.known, ~look.known, [*dots, UNKNOWN]
        colours[veil] = VEIL
    if anchors is HEIGHTS:
        values |= {"bar": _heights(look)}
    low, high = look.corners
    return Panel(low=low, high=high, mask=mask, colours=colours, veil=veil, dots=dots, **values)


def _heights(look: Look) -> tuple[str, Anchors, float, float]:
    return "height in the map / m", HEIGHTS, 0.0, float(look.grid.extent_m[2])


def _sensor(look: Look) -> list[StyledPoints]:
    return [(look.position[None], SENSOR)] * look.has_sensor


def _observed(look: Look, **values: Any) -> Panel | None:
    # what the truth does not know is known to the scan all the same
    return _map(replace(look, known=None), look.masks.get("observed"), **values)


def _returns(look: Look) -> Floats:
    """The returns (n, 3) in a sample's map."""
    points, (low, high) = np.zeros((0, 3)) if look.points is None else look.points, look.corners
    return points[((low <= points) & (points <= high)).all(axis=1)]


def _scan(look: Look, **values: Any) -> Panel | None:
    """Make a panel of the returns in a sample's map; if there are none, of its observed voxels."""
    (low, high), points = look.corners, _returns(look)
    if not len(points):
        return _observed(look, **values)
    points = points[np.argsort(points @ blocks.EYE)]  # near ones hide far ones
    shades = colour((points[:, 2] - low[2]) / (high - low)[2], HEIGHTS)
    size, many = float(np.clip(2e4 / len(points), 0.3, 3)), len(points) > blocks.MAX_VECTORS
    dots = points, {"c": shades, "s": size, "lw": 0, "zorder": 3, "rasterized": many}
    return Panel(low=low, high=high, dots=[dots, *_sensor(look)], bar=_heights(look), **values)


def _level_of(look: Look) -> int:
    """Return the level of voxels that has the sensor's height, or ends there."""
    # at a boundary between levels, the lower one
    level = math.ceil((look.position[2] - look.origin[2]) / look.grid.voxel_m) - 1
    return int(np.clip(level, 0, look.grid.shape[2] - 1))


def _level(look: Look, level: int, what: str, colours: Floats, known: Any, **values: Any) -> Panel:
    """Make a panel of a level of voxels: colours (X, Y, 3) where it is known, x right and y up."""
    image = np.dstack([colours, np.broadcast_to(known, colours.shape[:2])])
    # the middle of the level
    z = look.origin[2] + (level + 0.5) * look.grid.voxel_m
    # the sensor is drawn only where the level passes through it
    dots = _sensor(look) if abs(z - look.position[2]) <= look.grid.voxel_m else []
    dots = [*dots, *[UNKNOWN] * (not image[..., 3].all()), *values.pop("dots", ())]
    low, high, caption = *look.corners, f"{what}, z {z:.2f} m"
    return Panel(low=low, high=high, image=image, dots=dots, caption=caption, **values)


def _after_scan(look: Look) -> Panel | None:
    """Make a panel of what a scan tells of the sensor's level."""
    if not {"observed", "free"} <= look.masks.keys():
        return None
    level = _level_of(look)
    observed, free = (look.masks[name][:, :, level] for name in ("observed", "free"))
    height = colour(np.array((level + 0.5) / look.grid.shape[2]), HEIGHTS)
    colours = np.where(observed[..., None], height, 1.0)
    return _level(look, level, "known", colours, observed | free, dots=[FREE], bar=_heights(look))


def _distances(
    look: Look, tudf: Field | None, level: int | None = None, certain: Mask | None = None
) -> Panel | None:
    """Make a panel of distances (X, Y, Z), metres, at a level, by default the sensor's."""
    if tudf is None:
        return None
    level, far = _level_of(look) if level is None else level, look.grid.truncation_m
    known = True if certain is None else certain[:, :, level]
    bar = "distance / m", DISTANCES, 0.0, far
    colours = colour(tudf[:, :, level] / far, DISTANCES)
    return _level(look, level, "distance", colours, known, bar=bar)


def _paths(
    look: Look,
    mask: Mask | None,
    guesses: Iterable[Guess],
    names: Sequence[str],
    *,
    hits: bool = True,
    lines: Sequence[StyledPoints] = (),
    caption: str = "",
) -> Panel | None:
    """Make a panel of voxels with paths, and where these collide if `hits`. `names` are all methods
    of the picture; `lines` are further ones."""
    inks = dict(zip(names, canvas.path_colours(names), strict=True))
    further, lines, dots = len(lines), list(lines), list[StyledPoints]()
    for guess in guesses:
        if (route := guess.route) is None:
            continue
        for label, place, ink, marker, size in (
            ("start", route.start, rgb(canvas.START), "o", 36),
            ("goal", route.goal, rgb(canvas.GOAL), "*", 90),
            ("meets an obstacle", route.hit if hits else None, "black", "X", 36),
        ):
            if place is not None:
                style: dict[str, Any] = {"label": label, "color": ink, "marker": marker, "s": size}
                dots.append((place[None], BALL | style))
        if route.points is not None:
            # earlier paths are wider, so that all of several coinciding paths can be seen
            later = len(names) - 1 - names.index(guess.name)
            width, dashes = 2 + 1.2 * min(later, len(DASHES)), DASHES[later % len(DASHES)]
            ink, halo = rgb(inks[guess.name]), {"color": "white", "lw": width + 1.6}
            line = {"color": ink, "ls": dashes, "lw": width, "label": guess.name}
            # only the first, which is the widest, has a rim
            lines += [(route.points, halo)] * (len(lines) == further) + [(route.points, line)]
    return _map(look, mask, anchors=GREYS, dots=dots, lines=lines, caption=caption)


def _row(
    look: Look, figure: str, names: Sequence[str], box: Sequence[StyledPoints], caption: str
) -> dict[str, Panel | None]:
    """Make a row of a sample's panels by the names of their columns, see `draw`."""
    truth, by_name = look.masks.get("occupancy"), {guess.name: guess for guess in look.guesses}
    if figure == "sample":
        return {"scan": _scan(look), "observed": _observed(look), "truth": _map(look, truth)}
    if figure == "paths":
        return {"": _paths(look, truth, look.guesses, names, lines=box, caption=caption)}
    if figure == "sheet":
        if truth is None:
            return {"": _scan(look, caption=caption)}
        returns = {"label": "returns", "color": INK, "s": 1, "lw": 0, "zorder": 6}
        dots = [*_sensor(look), *[(_returns(look), returns)] * (look.points is not None)]
        return {"": _map(look, truth, dots=dots, caption=caption)}

    def predicted(name: str) -> Panel | None:
        if (guess := by_name.get(name)) is None:
            return None
        if figure == "distances":
            return _distances(look, guess.tudf)
        if figure == "completions":
            return _map(look, guess.occupied, truth=truth, caption=look.iou(guess))
        # a path that collides is free in its own prediction
        return _paths(look, guess.occupied, [guess], names, hits=False, caption=look.iou(guess))

    panels = {name: predicted(name) for name in names}
    if figure == "completions":
        return {"scan": _scan(look), "truth": _map(look, truth), **panels}
    if figure == "example":
        return {**panels, "truth": _paths(look, truth, look.guesses, names)}
    distances = partial(_distances, look, look.tudf, certain=look.certain)
    known = {"scan": _after_scan(look)}
    if figure == "levels":  # below a sample
        return known | {"observed": distances(), "truth": distances(3 * look.grid.shape[2] // 4)}
    return known | {"truth": distances(), **panels}


def draw(
    looks: Sequence[Look],
    figure: str = "",
    *,
    title: str = "",
    paper: Paper = SCREEN,
    box: tuple[Floats, Floats] | None = None,
) -> Figure:
    """Draw samples, or a scan, a map or a world.

    Args:
        looks: What to draw.
        figure: What to draw of it, as `render --figure` takes it: sample, completions, distances,
            paths or example; "" for completions if there are predictions, else sample.
        title: Title of the picture.
        paper: Size of the picture.
        box: For paths: lower and upper corner (3,) of a further box, metres in the world.

    Raises:
        DatasetError: Nothing is predicted, no path was planned, or the paper is too narrow.
    """
    look, *others = looks
    figure = figure or ("completions" if any(look.guesses for look in looks) else "sample")
    if figure == "sample" and (others or look.tudf is None):
        figure = "sheet"
    is_predicted = figure not in ("sample", "sheet")
    names = methods_of(looks, paths=figure in ("paths", "example")) if is_predicted else []
    texts = [look.name for look in looks] if others else [""]
    edges = []
    if box is not None:
        corners = np.array(list(itertools.product(*zip(*box, strict=True))))
        edges = [(corners[OUTLINE], {"label": "the map's box", "color": BLUE, "lw": 2})]
    cells = [
        _row(look, figure, names, edges, text) for look, text in zip(looks, texts, strict=True)
    ]
    below = {"sample": "levels", "completions": "distances"}.get(figure)
    if below and not others:  # a single sample has room for its levels
        cells.append(_row(look, below, names, [], ""))
    # panels of a single column have these texts as captions
    has_rows = others and len(cells[0]) > 1
    return compose(cells, texts if has_rows else [], title=title, paper=paper)


def with_path(
    look: Look, name: str, points: Floats, goal: Any = None, hit: Floats | None = None
) -> Look:
    """Add a path to a world, all of it in metres in the world.

    Args:
        look: The world.
        name: Name of the path.
        points: The path (n, 3).
        goal: Its goal (3,); None: it ends there.
        hit: Where it meets an obstacle (3,); None: nowhere.
    """
    goal = points[-1] if goal is None else np.array(goal)
    route = PlannedPath(start=points[0], goal=goal, points=points, told="", hit=hit)
    guess = Guess(name=name, occupied=look.masks["occupancy"], tudf=None, route=route)
    return replace(look, guesses=(*look.guesses, guess))


def methods_of(looks: Sequence[Look], *, paths: bool = False) -> list[str]:
    """Return the names of all methods that predict, in order.

    Args:
        looks: The samples.
        paths: Count only predictions on which a path was planned.

    Raises:
        DatasetError: No sample has such a prediction.
    """
    guesses = [
        guess for look in looks for guess in look.guesses if guess.route is not None or not paths
    ]
    if not guesses:
        fault = "no path was planned on a prediction" if paths else "nothing is predicted"
        raise DatasetError(
            f"{looks[0].name}: {fault}; give --weights or --predictions, and an existing --trial"
        )
    return list(dict.fromkeys(guess.name for guess in guesses))


def draw_patterns(sensors: Mapping[str, Sensor]) -> Figure:
    """Draw a panel for each sensor, by its name: each ray is a dot at its azimuth and elevation in
    degrees, from dark for the first in time to light for the last."""
    angles = [angles_deg(sensor.directions_body.reshape(-1, 3)) for sensor in sensors.values()]
    # a degree is about as long upwards as around, except in flat patterns, which stay readable
    heights = [max(1.2, 6 * np.ptp(up) / max(np.ptp(around), 1.0)) + 0.7 for up, around in angles]
    figure = Figure(figsize=(6.4, sum(heights)), dpi=100, layout="constrained")
    panels = figure.subplots(len(heights), squeeze=False, height_ratios=heights)[:, 0]
    for panel, (name, sensor), (up, around) in zip(panels, sensors.items(), angles, strict=True):
        panel.scatter(around, up, s=1, c=sensor.times_s.ravel(), cmap="viridis", linewidths=0)
        panel.set(xlabel="azimuth / °", ylabel="elevation / °", title=printable(name))
        panel.invert_xaxis()  # seen from the body, azimuth grows to the left
        panel.grid(alpha=0.4)
    return figure


def draw_sensor_unit(unit: "SensorUnit") -> Figure:
    """Draw the elevations of a unit less those of its model, its ranges, and the noise of
    planes."""
    figure = Figure(figsize=(9.6, 3.2), dpi=100, layout="constrained")
    beams, returns, noise = figure.subplots(1, 3)
    beams.plot(unit.elevations_deg, unit.off_deg, ".")
    beams.set(xlabel="elevation / °", ylabel=f"less {printable(unit.model.name)}'s / °")
    returns.hist(unit.ranges_m, 100)
    returns.set(xlabel="range / m", ylabel="returns", yscale="log")
    noise.semilogy(unit.planes[:, 0], 1e3 * unit.planes[:, 2], ".", ms=2)
    noise.set(xlabel="range / m", ylabel="noise of planes / mm")
    return figure
