"""The paper's figures of samples and predictions: one function each, from looks to a figure."""

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
"""A view from higher above, in which less hides a path."""
DASHES: tuple[Any, ...] = ((0, (6, 1.5)), (0, (2, 1.2)), "-", (0, (8, 1.5, 1.5, 1.5)))
"""Dashes of paths, in turn, for readers who cannot tell the colours apart."""


def draw_completions(looks: Sequence[Look], *, title: str, width: float | None = None) -> Figure:
    """Draw a row for each sample: its scan, its truth, and each method's prediction with its IoU
    and its errors in colours. A single sample has a second row: distances at the sensor's height.
    (The paper's comparison of completions.)

    Args:
        looks: The samples, with predictions.
        title: Title of the figure.
        width: Width of a figure for print, inches; None for the screen.

    Raises:
        DatasetError: Nothing is predicted, or the figure is too narrow.
    """
    names = ("scan", "truth", *methods_of(looks))
    is_single = len(looks) == 1
    errors = (
        (MISSED, f"missed by {DEEP} or more voxels"),
        (_pale(MISSED), "missed by one"),
        (INVENTED, f"invented, {DEEP} or more off"),
        (_pale(INVENTED), "invented, one off"),
    )
    handles = [ball("sensor"), *(Patch(color=rgb(shade), label=text) for shade, text in errors)]
    grid = Grid(len(looks) + is_single, len(names), title, handles, width=width)
    grid.name(names, [look.name for look in looks])
    ticks = is_single and not width  # several panels are too small for them, and so is print
    for row, look in enumerate(looks):
        for panel, mask in zip(grid.panels[row], ("points", "occupancy"), strict=False):
            draw_panel(panel, look, mask, "", ticks=ticks)
        for guess in look.guesses:
            panel = grid.panels[row, names.index(guess.name)]
            frame_box(panel, *look.corners, ticks=ticks)
            draw_voxels(panel, look, guess.occupied, truth=look.masks.get("occupancy"))
            put_note(panel, look.iou(guess))
    if is_single:
        _draw_levels(grid, 1, names, looks[0], "")
        grid.bar_of_distances(looks[0], row=1)
    grid.bar_of_heights(looks, row=0 if is_single else None)
    return grid.figure


def _pale(deep: Rgb) -> Any:
    return tuple(round(255 - PALE * (255 - part)) for part in deep)


def draw_distances(looks: Sequence[Look], *, title: str, width: float | None = None) -> Figure:
    """Draw a row for each sample: true distances at the sensor's height, and each method's.

    Args:
        looks: The samples, with predictions.
        title: Title of the figure.
        width: Width of a figure for print, inches; None for the screen.

    Raises:
        DatasetError: Nothing is predicted, or the figure is too narrow.
    """
    names = ["truth", *methods_of(looks)]
    grid = Grid(len(looks), len(names), title, [ball("sensor")], width=width)
    grid.name(names, [])
    for row, look in enumerate(looks):
        _draw_levels(grid, row, names, look, f"{look.name}, ")
    grid.bar_of_distances(looks[0])
    return grid.figure


def _draw_levels(grid: Grid, row: int, names: Sequence[str], look: Look, before: str) -> None:
    """Draw a row of distances at the sensor's height, the true ones and each method's, in the
    columns that `names` lists. The row's name is `before` and that height."""
    level = at_sensor(look)
    grid.name_row(row, f"{before}z = {height_of(look, level):.2f} m")
    for name, tudf in {
        "truth": look.tudf,
        **{guess.name: guess.tudf for guess in look.guesses},
    }.items():
        grid.level(row, names.index(name), look, level, tudf)


def draw_paths(looks: Sequence[Look], *, title: str, width: float | None = None) -> Figure:
    """Draw a panel for each sample: each method's path through the truth, and where it collides.
    (The paper's comparison of paths.)

    Args:
        looks: The samples, with predictions and paths.
        title: Title of the figure.
        width: Width of a figure for print, inches; None for the screen.

    Raises:
        DatasetError: No path was planned, or the figure is too narrow.
    """
    names = methods_of(looks, paths=True)
    columns = across(min(len(looks), 3), width)  # paths need larger panels than voxels
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
    """Draw a row for each sample: each method's prediction with its path, and last all paths in the
    truth. (The paper's first figure.)

    Args:
        looks: The samples, with predictions and paths.
        title: Title of the figure.
        width: Width of a figure for print, inches; None for the screen.

    Raises:
        DatasetError: No path was planned, or the figure is too narrow.
    """
    names = methods_of(looks, paths=True)
    grid = Grid(len(looks), 1 + len(names), title, _path_legend(names), width=width)
    grid.name((*names, "truth"), [look.name for look in looks])
    for row, look in enumerate(looks):
        for guess in look.guesses:
            panel = grid.panels[row, names.index(guess.name)]
            masks = {**look.masks, "occupancy": guess.occupied}
            # a path that collides is free in its own prediction: no hits here
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
"""Figures by the names that `render --figure` takes."""


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


def _draw_paths_in(
    panel: Any,
    look: Look,
    guesses: Sequence[Guess],
    names: Sequence[str],
    *,
    ticks: bool,
    hits: bool = True,
) -> None:
    """Draw occupied voxels, in front of them the paths of `guesses`, and where these collide."""
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
            # earlier paths are wider, so that all of several coinciding paths can be seen
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
    """Return colour and dashes of each method's path, by name."""
    styles = zip(names, path_colours(names), itertools.cycle(DASHES), strict=False)
    return {name: {"color": rgb(shade), "linestyle": dashes} for name, shade, dashes in styles}
