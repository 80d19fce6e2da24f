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

from scenegen.display.colours import DISTANCES, GOAL, HEIGHTS, INVENTED, MISSED, START, path_colours
from scenegen.display.look import Guess, Look
from scenegen.display.oblique import VIEW, View
from scenegen.display.still import (
    INK,
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


def draw_completions(looks: Sequence[Look], *, title: str) -> Figure:
    """A row for each sample: its scan, the truth, and each method's prediction, with what it missed
    and invented in colours of their own; under a single sample, the distances at the sensor's
    height. (The paper's comparison.)

    Raises DatasetError where nothing is predicted.
    """
    names = methods_of(looks)
    alone = len(looks) == 1
    figure, places = _grid(len(looks) + alone, 2 + len(names), title)
    for row, look in enumerate(looks):
        for n, name in enumerate(("points", "occupancy")):
            draw_panel(panel := figure.add_axes(places(row, n)), look, name, ticks=alone)
            panel.set_title(("scan", "truth")[n] if row == 0 else "", color=INK, fontsize=10)
        for guess in look.guesses:
            _predicted(
                figure.add_axes(places(row, 2 + names.index(guess.name))), look, guess, ticks=alone
            )
    if alone:
        (look,) = looks
        columns = [
            (1, "truth", look.tudf),
            *((2 + names.index(one.name), one.name, one.tudf) for one in look.guesses),
        ]
        for column, name, tudf in columns:
            left, down, wide, tall = places(1, column)
            panel = figure.add_axes(
                (left + 0.2 * wide, down + 0.14 * tall, 0.72 * wide, 0.74 * tall)
            )
            draw_level(panel, look, _level(look), tudf)
            panel.set_title(f"distances, {plain(name)}", color=INK, fontsize=10)
        add_bar(
            figure,
            _bar(places(1, 0), 0.55),
            DISTANCES,
            (0, look.grid.truncation_m),
            "to the nearest occupied / m",
        )
    _finish(figure, looks, [ball("sensor"), *_errors()])
    return figure


def draw_distances(looks: Sequence[Look], *, title: str) -> Figure:
    """A row for each sample: the true distances at the sensor's height, and each method's. Raises
    DatasetError where nothing is predicted."""
    names = methods_of(looks)
    figure, places = _grid(len(looks), 1 + len(names), title)
    for row, look in enumerate(looks):
        columns = [
            (0, "truth", look.tudf),
            *((1 + names.index(one.name), one.name, one.tudf) for one in look.guesses),
        ]
        for column, name, tudf in columns:
            left, down, wide, tall = places(row, column)
            panel = figure.add_axes(
                (left + 0.2 * wide, down + 0.16 * tall, 0.74 * wide, 0.74 * tall)
            )
            draw_level(panel, look, _level(look), tudf)
            panel.set_title(plain(name) if row == 0 else "", color=INK, fontsize=10)
    _finish(
        figure,
        looks,
        [ball("sensor")],
        DISTANCES,
        (0, looks[0].grid.truncation_m),
        "to the nearest occupied / m",
    )
    return figure


def draw_paths(looks: Sequence[Look], *, title: str) -> Figure:
    """A panel for each sample: every method's path in the truth, which it may meet. (The paper's
    comparison of paths.) Raises DatasetError where none was planned."""
    names = methods_of(looks, paths=True)
    columns = min(len(looks), 3)
    figure, places = _grid(
        math.ceil(len(looks) / columns), columns, title, scale=1.45 if columns < 3 else 1.2
    )
    for n, look in enumerate(looks):
        panel = figure.add_axes(places(n // columns, n % columns))
        _truth(panel, look, look.guesses, names, ticks=len(looks) == 1)
        panel.set_title(look.name, color=INK, fontsize=10)
    _finish(figure, looks, _path_legend(names))
    return figure


def draw_example(looks: Sequence[Look], *, title: str) -> Figure:
    """A row for each sample: each method's prediction with its path, and last all paths in the
    truth. (The paper's first figure.) Raises DatasetError where no path was planned."""
    names = methods_of(looks, paths=True)
    figure, places = _grid(len(looks), 1 + len(names), title)
    for row, look in enumerate(looks):
        for guess in look.guesses:
            panel = figure.add_axes(places(row, names.index(guess.name)))
            masks = {**look.masks, "occupancy": guess.occupied}
            _truth(
                panel,
                dataclasses.replace(look, masks=masks),
                (guess,),
                names,
                ticks=False,
                hits=False,
            )
            panel.set_title(plain(guess.name) if row == 0 else "", color=INK, fontsize=10)
        panel = figure.add_axes(places(row, len(names)))
        _truth(panel, look, look.guesses, names, ticks=False)
        panel.set_title("truth" if row == 0 else "", color=INK, fontsize=10)
    _finish(figure, looks, _path_legend(names))
    return figure


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


def _predicted(panel: Any, look: Look, guess: Guess, *, ticks: bool) -> None:
    low = look.origin
    frame_box(panel, low, low + look.grid.extent_m, ticks=ticks)
    draw_voxels(panel, look, guess.occupied, truth=look.masks.get("occupancy"))
    panel.set_title(plain(guess.name), color=INK, fontsize=10)


def _truth(
    panel: Any,
    look: Look,
    guesses: Sequence[Guess],
    names: Sequence[str],
    *,
    ticks: bool,
    hits: bool = True,
) -> None:
    """The occupied voxels with the paths of `guesses` before them."""
    view = VIEW if ticks else STEEP
    frame_box(panel, look.origin, look.origin + look.grid.extent_m, ticks=ticks, view=view)
    if (mask := look.masks.get("occupancy")) is None:
        say_unread(panel)
    else:
        draw_voxels(panel, look, mask, view=view)
    for n, guess in enumerate(guesses):
        if (route := guess.route) is None:
            continue
        for place, end in ((route.start, START), (route.goal, GOAL)):
            panel.scatter(
                *view.project(place),
                s=60,
                color=_rgb(end),
                edgecolors="white",
                linewidths=0.8,
                zorder=9,
            )
        if route.points is not None:
            style, shade = (
                _style(guess.name, names),
                _rgb(path_colours(names)[names.index(guess.name)]),
            )
            width = 2.0 + 3.0 * (len(guesses) - 1 - n) / max(
                len(names) - 1, 1
            )  # paths that coincide show all the same
            halo = [Stroke(linewidth=width + 2, foreground="white"), Normal()] if n == 0 else None
            looks_so = {
                "color": shade,
                "linewidth": width,
                "linestyle": style,
                "zorder": 8,
                "path_effects": halo,
            }
            panel.plot(*view.project(route.points).T, **looks_so)
        if route.hit is not None and hits:
            panel.scatter(
                *view.project(route.hit),
                s=60,
                marker="X",
                color="black",
                edgecolors="white",
                zorder=10,
            )


def _path_legend(names: Sequence[str]) -> list[Any]:
    colours = path_colours(names)
    paths = [
        line(plain(name), _rgb(colours[n]), 2.2, _style(name, names))
        for n, name in enumerate(names)
    ]
    cross = Line2D([], [], marker="X", linestyle="", color="black", label="meets an obstacle")
    return [*paths, ball("start", _rgb(START)), ball("goal", _rgb(GOAL)), cross]


def _style(name: str, names: Sequence[str]) -> Any:
    others = [one for one in names if one not in STYLES]
    return STYLES.get(name) or OTHER_STYLES[others.index(name) % len(OTHER_STYLES)]


def _errors() -> list[Any]:
    return [
        Patch(color=_rgb(MISSED), label="missed: occupied, not predicted"),
        Patch(color=_rgb(INVENTED), label="invented: predicted, not occupied"),
    ]


def _rgb(colour: tuple[int, int, int]) -> tuple[float, ...]:
    return tuple(value / 255 for value in colour)


def _level(look: Look) -> int:
    """The level of voxels just below the sensor."""
    height = (look.position[2] - look.origin[2]) / look.grid.voxel_m
    return int(np.clip(math.ceil(height) - 1, 0, look.grid.shape[2] - 1))


Place = tuple[float, float, float, float]


def _grid(
    rows: int, columns: int, title: str, scale: float = 1.0
) -> tuple[Figure, Callable[[int, int], Place]]:
    """A figure of panels, and the place of the panel in a row and column: left, bottom, width and
    height as shares."""
    wide, tall = scale * WIDE, scale * TALL
    width, height = wide * columns + 0.95, tall * rows + 0.85
    figure = blank(max(width, 6.5), height, title)
    width = max(width, 6.5)

    def place(row: int, column: int) -> Place:
        down = 0.4 + tall * (rows - 1 - row)
        return (
            (0.05 + wide * column) / width,
            down / height,
            0.98 * wide / width,
            0.92 * tall / height,
        )

    return figure, place


def _bar(place: Place, share: float) -> Place:
    """Where a bar stands in a panel's place that holds nothing else."""
    left, down, wide, tall = place
    return left + share * wide, down + 0.14 * tall, 0.04 * wide, 0.74 * tall


def _finish(
    figure: Figure,
    looks: Sequence[Look],
    handles: Sequence[Any],
    anchors: Any = HEIGHTS,
    ends: tuple[float, float] | None = None,
    label: str = "height over the map's floor / m",
) -> None:
    """The bar at the right, and the legend."""
    wide, tall = figure.get_size_inches()
    ends = ends or (0.0, max(look.grid.extent_m[2] for look in looks))
    high = min(2.4, tall - 1.2)
    add_bar(
        figure,
        (1 - 0.8 / wide, 0.5 - high / tall / 2, 0.13 / wide, high / tall),
        anchors,
        ends,
        label,
    )
    add_legend(figure, handles)
