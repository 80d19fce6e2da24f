"""The paper's figures, of samples and of what was predicted of them: one function each, from looks
to a figure.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from scenegen.base.errors import DatasetError
from scenegen.view.canvas import (
    DEEP,
    GOAL,
    INVENTED,
    MISSED,
    PALE,
    START,
    VIEW,
    Rgb,
    View,
    path_colours,
    rgb,
)
from scenegen.view.look import Guess, Look
from scenegen.view.panels import (
    Grid,
    across,
    at_sensor,
    ball,
    draw_panel,
    draw_voxels,
    frame_box,
    height_of,
    line,
    plain,
    put_ball,
    put_note,
    put_title,
)

STEEP = View(elevation=math.radians(50))
"""From higher above, so that fewer things hide a path."""
DASHES: tuple[Any, ...] = ((0, (6, 1.5)), (0, (2, 1.2)), "-", (0, (8, 1.5, 1.5, 1.5)))
"""Of paths, in turn, for readers who cannot tell the colours apart."""


def draw_completions(looks: Sequence[Look], *, title: str, width: float | None = None) -> Figure:
    """Draws a row for each sample: its scan, the truth, and each method's prediction with its IoU,
    and what it missed and invented in colours of their own; under a single sample, the distances at
    the sensor's height. (The paper's comparison.)

    `width` is that of the figure, inches. Raises DatasetError where nothing is predicted.
    """
    names = ("scan", "truth", *methods_of(looks))
    alone = len(looks) == 1
    errors = (
        (MISSED, f"missed by {DEEP} or more voxels"),
        (_pale(MISSED), "missed by one"),
        (INVENTED, f"invented, {DEEP} or more off"),
        (_pale(INVENTED), "invented, one off"),
    )
    handles = [ball("sensor"), *(Patch(color=rgb(shade), label=text) for shade, text in errors)]
    grid = Grid(len(looks) + alone, len(names), title, handles, width=width)
    grid.name(names, [look.name for look in looks])
    ticks = alone and not width
    for row, look in enumerate(looks):
        for panel, mask in zip(grid.panels[row], ("points", "occupancy"), strict=False):
            draw_panel(panel, look, mask, "", ticks=ticks)
        for guess in look.guesses:
            panel = grid.panels[row, names.index(guess.name)]
            frame_box(panel, *look.corners, ticks=ticks)
            draw_voxels(panel, look, guess.occupied, truth=look.masks.get("occupancy"))
            put_note(panel, look.iou(guess))
    if alone:
        _draw_levels(grid, 1, names, looks[0], "")
        grid.bar_of_distances(looks[0], row=1)
    grid.bar_of_heights(looks, row=0 if alone else None)
    return grid.figure


def _pale(deep: Rgb) -> Any:
    return tuple(round(255 - PALE * (255 - part)) for part in deep)


def draw_distances(looks: Sequence[Look], *, title: str, width: float | None = None) -> Figure:
    """Draws a row for each sample: the true distances at the sensor's height, and each method's.
    Raises DatasetError where nothing is predicted."""
    names = ["truth", *methods_of(looks)]
    grid = Grid(len(looks), len(names), title, [ball("sensor")], width=width)
    grid.name(names, [])
    for row, look in enumerate(looks):
        _draw_levels(grid, row, names, look, f"{look.name}, ")
    grid.bar_of_distances(looks[0])
    return grid.figure


def _draw_levels(grid: Grid, row: int, names: Sequence[str], look: Look, before: str) -> None:
    """Draws the true distances at the sensor's height, and each method's, in the columns of their
    names; the row's name is `before` and that height."""
    level = at_sensor(look)
    grid.name_row(row, f"{before}z = {height_of(look, level):.2f} m")
    for name, tudf in {
        "truth": look.tudf,
        **{guess.name: guess.tudf for guess in look.guesses},
    }.items():
        grid.level(row, names.index(name), look, level, tudf)


def draw_paths(looks: Sequence[Look], *, title: str, width: float | None = None) -> Figure:
    """Draws a panel for each sample: every method's path in the truth, which it may meet. (The
    paper's comparison of paths.) Raises DatasetError where none was planned."""
    names = methods_of(looks, paths=True)
    columns = across(min(len(looks), 3), width)
    scale = 1.45 if columns < 3 else 1.2
    handles = _path_legend(names)
    grid = Grid(math.ceil(len(looks) / columns), columns, title, handles, scale=scale, width=width)
    for panel, look in zip(grid.panels.flat, looks, strict=False):
        _draw_paths_in(panel, look, look.guesses, names, ticks=len(looks) == 1 and not width)
        if len(looks) > 1 or not title:
            put_title(panel, look.name)
    grid.bar_of_heights(looks)
    return grid.figure


def draw_example(looks: Sequence[Look], *, title: str, width: float | None = None) -> Figure:
    """Draws a row for each sample: each method's prediction with its path, and last all paths in
    the truth. (The paper's first figure.) Raises DatasetError where no path was planned."""
    names = methods_of(looks, paths=True)
    grid = Grid(len(looks), 1 + len(names), title, _path_legend(names), width=width)
    grid.name((*names, "truth"), [look.name for look in looks])
    for row, look in enumerate(looks):
        for guess in look.guesses:
            panel = grid.panels[row, names.index(guess.name)]
            masks = {**look.masks, "occupancy": guess.occupied}
            believed = dataclasses.replace(look, masks=masks)
            _draw_paths_in(panel, believed, (guess,), names, ticks=False, hits=False)
            put_note(panel, look.iou(guess))
        _draw_paths_in(grid.panels[row, -1], look, look.guesses, names, ticks=False)
    grid.bar_of_heights(looks)
    return grid.figure


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
    draw_voxels(panel, look, look.masks.get("occupancy"), view=view)
    styles = _path_styles(names)
    for n, guess in enumerate(guesses):
        if (route := guess.route) is None:
            continue
        for place, end, mark in ((route.start, START, "o"), (route.goal, GOAL, "*")):
            at = view.project(place)
            put_ball(panel, at, size=90, color=rgb(end), order=9, marker=mark)
        if route.points is not None:
            # the first is the widest, so that paths that coincide show all the same
            width = 2.0 + 3.0 * (len(guesses) - 1 - n) / max(len(names) - 1, 1)
            halo = [Stroke(linewidth=width + 2, foreground="white"), Normal()] if n == 0 else None
            places = view.project(route.points).T
            panel.plot(*places, linewidth=width, zorder=8, path_effects=halo, **styles[guess.name])
        if route.hit is not None and hits:
            at = view.project(route.hit)
            panel.scatter(*at, s=60, zorder=10, marker="X", color="black", edgecolors="white")


def _path_legend(names: Sequence[str]) -> list[Any]:
    paths = [
        line(plain(name), style["color"], 2.2, style["linestyle"])
        for name, style in _path_styles(names).items()
    ]
    ends = [ball("start", rgb(START)), ball("goal", rgb(GOAL), "*")]
    return [*paths, *ends, ball("meets an obstacle", "black", "X")]


def _path_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour and dashes of each method's path."""
    styles = zip(names, path_colours(names), itertools.cycle(DASHES), strict=False)
    return {name: {"color": rgb(shade), "linestyle": dashes} for name, shade, dashes in styles}
