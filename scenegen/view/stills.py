"""Pictures by matplotlib, for papers and for the screen: of samples, predictions, scans and worlds.

A picture is rows of panels. A `Panel` is data: a box, and the blocks, lines, dots or image in it.
`compose` draws all of them, with one legend, which lists what has a label.
"""

import io
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

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
from scenegen.view.look import Guess, Look, Route

Part = tuple[Floats, dict[str, Any]]
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
DASHES: tuple[Any, ...] = ((0, (6, 1.5)), (0, (2, 1.2)), "-", (0, (8, 1.5, 1.5, 1.5)))
"""Dashes of paths, in turn, for readers who cannot tell the colours apart."""
BALL: dict[str, Any] = {"s": 36, "ec": "white", "lw": 0.7, "zorder": 9}
"""Style of balls and other marks in front of all else."""
SENSOR = BALL | {"label": "sensor", "color": rgb(canvas.SENSOR)}
HATCH: dict[str, Any] = {"fc": "#eef0f2", "ec": SOFT, "hatch": "//////"}
"""Style of unknown voxels in a level."""


def _patch(label: str, **style: Any) -> Part:
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
    colours: Floats | None = None
    """Their colours, see `draw_blocks`."""
    veil: Mask | None = None
    """Unknown voxels."""
    image: Floats | None = None
    """Colours (X, Y, 4) of a level, which is then seen from above; without opacity: unknown."""
    dots: Sequence[Part] = ()
    """Balls and points."""
    lines: Sequence[Part] = ()
    """Paths."""
    inner: tuple[Floats, Floats] | None = None
    """Corners of a further box."""
    bar: tuple[str, Anchors, float, float] | None = None
    """Label of a colour bar, its scale, and the values of its ends."""
    caption: str = ""
    """Text below it."""

    def place(self, points: Floats) -> Floats:
        """Place points (n, 3) on the paper (n, 2), metres."""
        return project(points) if self.image is None else points[:, :2]

    def limits(self) -> Floats:
        """Return left and right, lower and upper end (2, 2) on the paper, metres."""
        boxes = [(self.low, self.high), *filter(None, [self.inner])]
        edges = [np.concatenate(blocks.box_edges(*corners)).reshape(-1, 3) for corners in boxes]
        paper = self.place(np.concatenate(edges))
        room = 0.05 * np.ptp(paper, axis=0).max() if self.image is None else 0
        return np.stack([paper.min(axis=0) - room, paper.max(axis=0) + room], axis=1)

    def draw(self, axes: Any, width: float) -> None:
        """Draw it on axes of matplotlib that are so many inches wide."""
        limits = self.limits()
        thin = float(np.clip(width / PANEL, 0.5, 1))
        axes.set(xlim=limits[0], ylim=limits[1], xlabel=printable(self.caption))
        axes.set_frame_on(self.image is not None)
        if self.image is not None:
            axes.fill_between(limits[0], *limits[1], **HATCH)
            image, extent = self.image.swapaxes(0, 1), limits.ravel()
            axes.imshow(image, origin="lower", extent=extent, aspect="auto", zorder=2)
        else:
            blocks.draw_box(axes, self.low, self.high, INK, thin)
        if self.mask is not None:
            voxel = 72 * width * (self.high - self.low)[0] / np.ptp(limits[0]) / len(self.mask)
            blocks.draw_blocks(
                axes, self.low, self.high, self.mask, self.colours, self.veil, min(voxel / 12, 0.5)
            )
        if self.inner is not None:
            blocks.draw_box(axes, *self.inner, BLUE, 2 * thin)
        for points, style in self.lines:
            axes.plot(*self.place(points).T, **style | {"lw": thin * style["lw"], "zorder": 8})
        for points, style in self.dots:
            axes.scatter(*self.place(points).T, **style | {"s": thin**2 * style["s"]})
        if width >= WIDE:
            self._name_axes(axes)

    def _name_axes(self, axes: Any) -> None:
        """Write ends of the axes, metres: as ticks, or along edges of the box."""
        if self.image is not None:
            for axis, name in ((axes.xaxis, "x / m"), (axes.yaxis, "y / m")):
                axis.set_major_locator(MaxNLocator(4))
                axis.set_label_text(f"{name}\n{axis.get_label_text()}".rstrip())
            return
        starts = self.low, np.where([True, False, False], self.high, self.low), self.low
        for n, (start, offset) in enumerate(zip(starts, ((-4, -6), (4, -6), (-6, 0)), strict=True)):
            end = np.where(np.arange(3) == n, self.high, start)
            first, last = project([start, end])
            axes.annotate(
                f"{'xyz'[n]}: {start[n]:.1f} … {end[n]:.1f} m",
                (first + last) / 2,
                offset,
                textcoords="offset points",
                rotation=math.degrees(math.atan2(*(last - first)[::-1])),
                ha="center",
                va="center",
            )


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
    cells: Sequence[Sequence[Panel | None]],
    *,
    columns: Sequence[str] = (),
    rows: Sequence[str] = (),
    title: str = "",
    paper: Paper = SCREEN,
) -> Figure:
    """Draw panels in rows, with colour bars and one legend below them.

    Columns without a panel are left out. A single column is dealt to rows. If the paper is too
    narrow, rows and columns change places.

    Args:
        cells: Panels of each row; None for an empty place.
        columns: Names above columns.
        rows: Names beside rows.
        title: Title, which print does not have.
        paper: Size of the picture.

    Raises:
        DatasetError: The columns are too narrow either way, or there is no panel.
    """
    fit = max(1, int(paper.width / MIN_PANEL)) if paper.width else MAX_ACROSS
    full = [any(column) for column in zip(*cells, strict=True)]
    cells = [list(itertools.compress(row, full)) for row in cells]
    columns = list(itertools.compress(columns, full))
    if len(cells[0]) == 1:
        single = [part for row in cells for part in row]
        beside = min(fit, SHEET, len(single))
        single += [None] * (-len(single) % beside)
        cells = [single[n : n + beside] for n in range(0, len(single), beside)]
    elif len(cells[0]) > fit:
        cells, columns, rows = list(zip(*cells, strict=True)), rows, columns
    if not 0 < (count := len(cells[0])) <= fit:
        raise DatasetError(
            f"{count} panels side by side are too narrow to be read; give a wider --paper, or draw "
            "fewer samples or methods"
        )
    parts = [(n, m, part) for n, row in enumerate(cells) for m, part in enumerate(row) if part]
    sizes = [np.ptp(part.limits(), axis=1) for *_, part in parts]
    bars = {part.bar[0]: part.bar for *_, part in parts if part.bar}
    labels = {style.get("label", "") for *_, p in parts for _, style in [*p.dots, *p.lines]}

    # lengths in inches, from the upper left corner
    em, wide = paper.points / 72, paper.width or count * max(PANEL, ALONE / count)
    has_ticks = wide / count >= WIDE and any(part.image is not None for *_, part in parts)
    title = "" if paper.width else title
    left, top = 2 * em * bool(rows), em * (0.6 + 2 * bool(title) + 2 * bool(columns))
    beside, below = (4.2 * em, 4.2 * em) if has_ticks else (0.8 * em, 2.2 * em)
    width = (wide - left - 0.4 * em) / count - beside
    heights = np.zeros(len(cells))
    for (n, *_), (right, up) in zip(parts, sizes, strict=True):
        heights[n] = max(heights[n], width * up / right)
    lefts = left + beside + (width + beside) * np.arange(count)
    tops = top + np.cumsum([0, *(heights + below)])
    ncols = max(1, int(wide / (em * (0.55 * max(map(len, labels), default=0) + 4))))
    high = tops[-1] + em * (4.2 * bool(bars) + 1.7 * -(-len(labels) // ncols))
    with rc_context(style(paper)):
        figure = Figure(figsize=(wide, high))

        def add_axes(x: float, y: float, width: float, height: float) -> Any:
            place = x / wide, 1 - (y + height) / high, width / wide, height / high
            axes = figure.add_axes(place, xticks=[], yticks=[])
            axes.tick_params(labelsize=paper.points, length=2, pad=2)
            return axes

        def write(x: float, y: float, text: str, room: float, **values: Any) -> None:
            text = printable(text)[: max(3, int(room / (0.58 * em)))]
            figure.text(x / wide, 1 - y / high, text, ha="center", va="center", **values)

        for (n, m, part), (right, up) in zip(parts, sizes, strict=True):
            tall = width * up / right
            axes = add_axes(lefts[m], tops[n] + (heights[n] - tall) / 2, width, tall)
            part.draw(axes, width)
        write(wide / 2, 1.4 * em, title, wide / 1.2, fontsize=1.2 * paper.points)
        for x, text in zip(lefts, columns, strict=False):
            write(x + width / 2, top - 0.9 * em, text, width)
        for y, height, text in zip(tops, heights, rows, strict=False):
            write(0.9 * em, y + height / 2, text, height, rotation=90)
        room = wide / max(len(bars), 1)
        for n, (label, anchors, *ends) in enumerate(bars.values()):
            length = min(2.4, 0.75 * room)
            axes = add_axes((n + 0.5) * room - length / 2, tops[-1], length, 0.6 * em)
            shades = ListedColormap(colour(np.linspace(0, 1, 256), anchors))
            values, ticks = ScalarMappable(Normalize(*ends), shades), MaxNLocator(4)
            figure.colorbar(values, axes, orientation="horizontal", label=label, ticks=ticks)
        pairs = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in figure.axes]
        marks = {label: mark for mark, label in itertools.chain(*pairs)}
        figure.legend(marks.values(), marks, loc="lower center", ncols=ncols, frameon=False)
    return figure


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
    dots: Sequence[Part] | None = None,
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
    if values.get("inner") is not None:
        dots = [*dots, _patch("the map's box", fc="none", ec=BLUE)]
    if look.known is not None:
        mask, veil, dots = mask & look.known, ~look.known, [*dots, UNKNOWN]
        colours[veil] = VEIL
    if anchors is HEIGHTS:
        values |= {"bar": _heights(look)}
    low, high = look.corners
    return Panel(low=low, high=high, mask=mask, colours=colours, veil=veil, dots=dots, **values)


def _heights(look: Look) -> tuple[str, Anchors, float, float]:
    return "height in the map / m", HEIGHTS, 0.0, float(look.grid.extent_m[2])


def _sensor(look: Look) -> list[Part]:
    return [(look.position[None], SENSOR)] * look.has_sensor


def _scan(look: Look) -> Panel | None:
    """Make a panel of a sample's returns; if there are none, of its observed voxels."""
    if (points := look.points) is None or not len(points):
        return _map(look, look.masks.get("observed"))
    low, high = look.corners
    points = points[np.argsort(points @ blocks.EYE)]  # near ones hide far ones
    shades = colour((points[:, 2] - low[2]) / (high - low)[2], HEIGHTS)
    size, many = float(np.clip(2e4 / len(points), 0.3, 3)), len(points) > blocks.MAX_VECTORS
    dots = points, {"c": shades, "s": size, "lw": 0, "zorder": 3, "rasterized": many}
    return Panel(low=low, high=high, dots=[dots, *_sensor(look)], bar=_heights(look))


def _level_of(look: Look) -> int:
    """Return the level of voxels that has the sensor's height, or ends there."""
    # at a boundary between levels, the lower one
    level = math.ceil((look.position[2] - look.origin[2]) / look.grid.voxel_m) - 1
    return int(np.clip(level, 0, look.grid.shape[2] - 1))


def _level(look: Look, level: int, what: str, colours: Floats, known: Any, **values: Any) -> Panel:
    """Make a panel of a level of voxels: colours (X, Y, 3) where it is known, x right and y up."""
    image = np.dstack([colours, np.broadcast_to(known, colours.shape[:2])])
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
    guesses: Iterable[Guess | None],
    names: Sequence[str],
    *,
    hits: bool = True,
    **values: Any,
) -> Panel | None:
    """Make a panel of voxels with paths. `names` are all methods of the picture."""
    inks = dict(zip(names, canvas.path_colours(names), strict=True))
    lines, dots = list[Part](), list[Part]()
    for guess in filter(None, guesses):
        if (route := guess.route) is None:
            continue
        for label, place, ink, marker, size in (
            ("start", route.start, rgb(canvas.START), "o", 36),
            ("goal", route.goal, rgb(canvas.GOAL), "*", 90),
            ("meets an obstacle", route.hit if hits else None, "black", "X", 36),
        ):
            if place is not None:
                style = {"label": label, "color": ink, "marker": marker, "s": size}
                dots.append((place[None], BALL | style))
        if route.points is not None:
            # earlier paths are wider, so that all of several coinciding paths can be seen
            n = names.index(guess.name)
            width, dashes = 2 + 1.2 * (len(names) - 1 - n), DASHES[n % len(DASHES)]
            style = {"color": rgb(inks[guess.name]), "ls": dashes, "lw": width, "label": guess.name}
            halo = [] if lines else [(route.points, {"color": "white", "lw": width + 1.6})]
            lines += [*halo, (route.points, style)]
    return _map(look, mask, anchors=GREYS, dots=dots, lines=lines, **values)


def _row(look: Look, figure: str, names: Sequence[str], **values: Any) -> list[Panel | None]:
    """Make a row of a sample's panels, see `draw`; of a method that did not predict it, none."""
    masks, by_name = look.masks, {guess.name: guess for guess in look.guesses}
    truth, guesses = masks.get("occupancy"), [by_name.get(name) for name in names]
    match figure:
        case "sample":
            return [_scan(look), _map(look, masks.get("observed")), _map(look, truth)]
        case "sample's levels":
            levels = None, 3 * look.grid.shape[2] // 4
            fields = [_distances(look, look.tudf, level, look.certain) for level in levels]
            return [_after_scan(look), *fields]
        case "sheet":
            if truth is None:
                return [_scan(look)]
            returns = {"label": "returns", "color": INK, "s": 1, "lw": 0, "zorder": 6}
            dots = [] if look.points is None else [(look.points, returns)]
            return [_map(look, truth, dots=[*_sensor(look), *dots], **values)]
        case "completions":
            made = [g and _map(look, g.occupied, truth=truth, caption=look.iou(g)) for g in guesses]
            return [_scan(look), _map(look, truth), *made]
        case "distances":
            made = [g and _distances(look, g.tudf) for g in guesses]
            return [_after_scan(look), _distances(look, look.tudf, None, look.certain), *made]
        case "example":
            made = [  # a path that collides is free in its own prediction
                g and _paths(look, g.occupied, [g], names, hits=False, caption=look.iou(g))
                for g in guesses
            ]
            return [*made, _paths(look, truth, guesses, names)]
    return [_paths(look, truth, guesses, names, **values)]


def draw(
    looks: Sequence[Look],
    figure: str = "",
    *,
    title: str = "",
    paper: Paper = SCREEN,
    box: Any = None,
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
    several = len(looks) > 1
    figure = figure or ("completions" if any(look.guesses for look in looks) else "sample")
    if figure == "sample" and (several or looks[0].tudf is None):
        figure = "sheet"
    is_predicted = figure not in ("sample", "sheet")
    names = methods_of(looks, paths=figure in ("paths", "example")) if is_predicted else []
    captions = [look.name * several for look in looks]
    cells = [
        _row(look, figure, names, caption=caption, inner=box)
        for look, caption in zip(looks, captions, strict=True)
    ]
    below = {"sample": "sample's levels", "completions": "distances"}.get(figure)
    if below and not several:  # a single sample has room for its levels
        cells.append(_row(looks[0], below, names))
    columns = {
        "sample": ["scan", "observed voxels", "truth"],
        "completions": ["scan", "truth", *names],
        "distances": ["scan", "truth", *names],
        "example": [*names, "truth"],
    }.get(figure, [])
    rows = captions if several and columns else []
    return compose(cells, columns=columns, rows=rows, title=title, paper=paper)


def with_path(look: Look, name: str, points: Floats, hit: Floats | None = None) -> Look:
    """Add a path to a world: its name, points (n, 3), and where it meets an obstacle (3,), metres
    in the world."""
    route = Route(start=points[0], goal=points[-1], points=points, told="", hit=hit)
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
    heights = [max(1.2, 6 * np.ptp(up) / max(np.ptp(around), 1.0)) + 0.7 for up, around in angles]
    figure = Figure(figsize=(6.4, sum(heights)), dpi=100, layout="constrained")
    panels = figure.subplots(len(heights), squeeze=False, height_ratios=heights)[:, 0]
    for panel, (name, sensor), (up, around) in zip(panels, sensors.items(), angles, strict=True):
        panel.scatter(around, up, s=1, c=sensor.times_s.ravel(), cmap="viridis", linewidths=0)
        panel.set(xlabel="azimuth / °", ylabel="elevation / °", title=printable(name))
        panel.invert_xaxis()  # seen from the body, azimuth grows to the left
        panel.grid(alpha=0.4)
    return figure
