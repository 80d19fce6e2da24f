"""The paper's figures, of samples and of what was predicted of them: one function each, from looks
to a figure."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from scenegen.display.colours import (
    DISTANCES,
    GOAL,
    HEIGHTS,
    INVENTED,
    MISSED,
    START,
    path_colours,
    rgb,
)
from scenegen.display.look import Guess, Look
from scenegen.display.oblique import VIEW, View
from scenegen.display.panels import (
    Place,
    add_bar,
    add_legend,
    ball,
    blank,
    draw_level,
    draw_panel,
    draw_voxels,
    frame_box,
    line,
    plain,
    put_ball,
    put_title,
    say_unread,
)
from scenegen.errors import DatasetError

STEEP = View(elevation=math.radians(50))
"""From higher above, so that fewer things hide a path."""
STYLES = {"tudf": (0, (6, 1.5)), "occ": (0, (2, 1.2)), "proposed": "-"}
"""Dashes of paths by the names of the paper's networks, for readers who cannot tell the colours
apart."""
OTHER_STYLES: tuple[Any, ...] = ((0, (8, 1.5, 1.5, 1.5)), (0, (1, 1)), (0, (4, 1, 1, 1, 1, 1)))
WIDE, TALL = 3.05, 2.6
"""A panel with voxels, inches."""
TO_NEAREST = "to the nearest occupied / m"


class Grid:
    """A figure of panels in rows and columns, with a bar at its right and a legend below."""

    def __init__(self, rows: int, columns: int, title: str, scale: float = 1.0):
        self._rows, self._wide, self._tall = rows, scale * WIDE, scale * TALL
        self.width = max(self._wide * columns + 0.95, 6.5)
        self.height = self._tall * rows + 0.85
        self.figure = blank(self.width, self.height, title)

    def place(self, row: int, column: int, inset: Place = (0, 0, 1, 1)) -> Place:
        """The place of a panel, or of a part of it: `inset` in shares of the panel."""
        left, down, wide, tall = inset
        panel_left = 0.05 + self._wide * column
        panel_down = 0.4 + self._tall * (self._rows - 1 - row)
        panel_wide, panel_tall = 0.98 * self._wide, 0.92 * self._tall
        return (
            (panel_left + left * panel_wide) / self.width,
            (panel_down + down * panel_tall) / self.height,
            wide * panel_wide / self.width,
            tall * panel_tall / self.height,
        )

    def panel(self, row: int, column: int, inset: Place = (0, 0, 1, 1)) -> Any:
        """The axes at that place."""
        return self.figure.add_axes(self.place(row, column, inset))

    def levels(self, row: int, look: Look, columns: Sequence[tuple[int, str, Any]]) -> None:
        """Distances at the sensor's height: panels of (column, title, distances)."""
        height = math.ceil((look.position[2] - look.origin[2]) / look.grid.voxel_m) - 1
        level = int(np.clip(height, 0, look.grid.shape[2] - 1))
        for column, title, tudf in columns:
            panel = self.panel(row, column, (0.2, 0.15, 0.73, 0.74))
            draw_level(panel, look, level, tudf)
            put_title(panel, title)

    def finish(self, looks: Sequence[Look], handles: Sequence[Any], *, distances: bool) -> Figure:
        """Adds the bar, of distances or of heights, and the legend."""
        high = min(2.4, self.height - 1.2) / self.height
        place = (1 - 0.8 / self.width, 0.5 - high / 2, 0.13 / self.width, high)
        if distances:
            add_bar(self.figure, place, DISTANCES, (0, looks[0].grid.truncation_m), TO_NEAREST)
        else:
            highest = max(look.grid.extent_m[2] for look in looks)
            add_bar(self.figure, place, HEIGHTS, (0, highest), "height over the map's floor / m")
        add_legend(self.figure, handles)
        return self.figure


def draw_completions(looks: Sequence[Look], *, title: str) -> Figure:
    """Draws a row for each sample: its scan, the truth, and each method's prediction, with what it
    missed and invented in colours of their own; under a single sample, the distances at the
    sensor's height. (The paper's comparison.)

    Raises DatasetError where nothing is predicted.
    """
    names = methods_of(looks)
    alone = len(looks) == 1
    grid = Grid(len(looks) + alone, 2 + len(names), title)
    for row, look in enumerate(looks):
        for n, (name, head) in enumerate((("points", "scan"), ("occupancy", "truth"))):
            draw_panel(panel := grid.panel(row, n), look, name, ticks=alone)
            put_title(panel, head if row == 0 else "")
        for guess in look.guesses:
            panel = grid.panel(row, 2 + names.index(guess.name))
            frame_box(panel, *look.corners, ticks=alone)
            draw_voxels(panel, look, guess.occupied, truth=look.masks.get("occupancy"))
            put_title(panel, plain(guess.name))
    if alone:
        (look,) = looks
        told = [(2 + names.index(one.name), one.name, one.tudf) for one in look.guesses]
        columns = [(1, "truth", look.tudf), *told]
        grid.levels(1, look, [(n, f"distances, {plain(name)}", tudf) for n, name, tudf in columns])
        bar = grid.place(1, 0, (0.55, 0.14, 0.04, 0.74))
        add_bar(grid.figure, bar, DISTANCES, (0, look.grid.truncation_m), TO_NEAREST)
    missed = Patch(color=rgb(MISSED), label="missed: occupied, not predicted")
    invented = Patch(color=rgb(INVENTED), label="invented: predicted, not occupied")
    return grid.finish(looks, [ball("sensor"), missed, invented], distances=False)


def draw_distances(looks: Sequence[Look], *, title: str) -> Figure:
    """Draws a row for each sample: the true distances at the sensor's height, and each method's.
    Raises DatasetError where nothing is predicted."""
    names = methods_of(looks)
    grid = Grid(len(looks), 1 + len(names), title)
    for row, look in enumerate(looks):
        told = [(1 + names.index(one.name), one.name, one.tudf) for one in look.guesses]
        columns = [(0, "truth", look.tudf), *told]
        grid.levels(
            row, look, [(n, plain(name) if row == 0 else "", tudf) for n, name, tudf in columns]
        )
    return grid.finish(looks, [ball("sensor")], distances=True)


def draw_paths(looks: Sequence[Look], *, title: str) -> Figure:
    """Draws a panel for each sample: every method's path in the truth, which it may meet. (The
    paper's comparison of paths.) Raises DatasetError where none was planned."""
    names = methods_of(looks, paths=True)
    columns = min(len(looks), 3)
    scale = 1.45 if columns < 3 else 1.2
    grid = Grid(math.ceil(len(looks) / columns), columns, title, scale)
    for n, look in enumerate(looks):
        panel = grid.panel(n // columns, n % columns)
        _draw_paths_in(panel, look, look.guesses, names, ticks=len(looks) == 1)
        put_title(panel, look.name)
    return grid.finish(looks, _path_legend(names), distances=False)


def draw_example(looks: Sequence[Look], *, title: str) -> Figure:
    """Draws a row for each sample: each method's prediction with its path, and last all paths in
    the truth. (The paper's first figure.) Raises DatasetError where no path was planned."""
    names = methods_of(looks, paths=True)
    grid = Grid(len(looks), 1 + len(names), title)
    for row, look in enumerate(looks):
        for guess in look.guesses:
            panel = grid.panel(row, names.index(guess.name))
            masks = {**look.masks, "occupancy": guess.occupied}
            believed = dataclasses.replace(look, masks=masks)
            _draw_paths_in(panel, believed, (guess,), names, ticks=False, hits=False)
            put_title(panel, plain(guess.name) if row == 0 else "")
        panel = grid.panel(row, len(names))
        _draw_paths_in(panel, look, look.guesses, names, ticks=False)
        put_title(panel, "truth" if row == 0 else "")
    return grid.finish(looks, _path_legend(names), distances=False)


FIGURES: dict[str, Callable[..., Figure]] = {
    "completions": draw_completions,
    "distances": draw_distances,
    "paths": draw_paths,
    "example": draw_example,
}
"""By name."""


def methods_of(looks: Sequence[Look], *, paths: bool = False) -> list[str]:
    """Who predicts, in order. Raises DatasetError where nobody does, or, with `paths`, no path was
    planned."""
    guesses = [
        guess for look in looks for guess in look.guesses if guess.route is not None or not paths
    ]
    if not guesses:
        what = "no path is planned on what is predicted" if paths else "nothing is predicted"
        raise DatasetError(
            f"{looks[0].name}: {what}; give --weights or --predictions, and a --trial that there is"
        )
    return list(dict.fromkeys(guess.name for guess in guesses))


def _draw_paths_in(
    panel: Any,
    look: Look,
    guesses: Sequence[Guess],
    names: Sequence[str],
    *,
    ticks: bool,
    hits: bool = True,
) -> None:
    """Draws the occupied voxels with the paths of `guesses` before them, and where they hit."""
    view = VIEW if ticks else STEEP
    frame_box(panel, *look.corners, ticks=ticks, view=view)
    if (mask := look.masks.get("occupancy")) is None:
        say_unread(panel)
    else:
        draw_voxels(panel, look, mask, view=view)
    styles = _path_styles(names)
    for n, guess in enumerate(guesses):
        if (route := guess.route) is None:
            continue
        for place, end in ((route.start, START), (route.goal, GOAL)):
            put_ball(panel, view.project(place), size=60, color=rgb(end), order=9)
        if route.points is not None:
            # the first is the widest, so that paths that coincide show all the same
            width = 2.0 + 3.0 * (len(guesses) - 1 - n) / max(len(names) - 1, 1)
            halo = [Stroke(linewidth=width + 2, foreground="white"), Normal()] if n == 0 else None
            style = {"linewidth": width, "zorder": 8, "path_effects": halo, **styles[guess.name]}
            panel.plot(*view.project(route.points).T, **style)
        if route.hit is not None and hits:
            cross = {"marker": "X", "color": "black", "edgecolors": "white"}
            panel.scatter(*view.project(route.hit), s=60, zorder=10, **cross)


def _path_legend(names: Sequence[str]) -> list[Any]:
    paths = [
        line(plain(name), style["color"], 2.2, style["linestyle"])
        for name, style in _path_styles(names).items()
    ]
    cross = Line2D([], [], marker="X", linestyle="", color="black", label="meets an obstacle")
    return [*paths, ball("start", rgb(START)), ball("goal", rgb(GOAL)), cross]


def _path_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour and dashes of each method's path."""
    others = [name for name in names if name not in STYLES]
    dashes = [
        STYLES.get(name) or OTHER_STYLES[others.index(name) % len(OTHER_STYLES)] for name in names
    ]
    return {
        name: {"color": rgb(shade), "linestyle": dash}
        for name, shade, dash in zip(names, path_colours(names), dashes, strict=True)
    }
