"""Samples, what is predicted of them, and paths: a page in a notebook, a file, or a browser."""

import base64
import html
import importlib.util
import sys
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import GridSpec, Sensor
from scenegen.display.look import Guess, Look, Route, look_at
from scenegen.display.page import page
from scenegen.errors import DatasetError
from scenegen.files import write_result
from scenegen.sample import Sample

TALL = 620
"""Height of a page in a notebook, pixels."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shown:
    """What `show` shows; a notebook shows it as the last value of a cell."""

    html: str
    """The page."""
    looks: Sequence[Look]
    """What is on it."""

    def __repr__(self) -> str:
        return f"<Shown: {', '.join(look.name for look in self.looks)}>"

    def _repr_html_(self) -> str:
        """The page in a frame; below it a picture of the first sample, which is what one sees where
        frames or scripts are not to be had, as on GitHub."""
        if importlib.util.find_spec("matplotlib") is None:
            below = "<p>A picture where no scripts run needs matplotlib: the extra view.</p>"
        else:
            below = f'<img src="{self._picture()}" style="max-width: 100%; max-height: 100%">'
        frame = "position: absolute; inset: 0; width: 100%; height: 100%; border: 0"
        return (
            f'<div style="position: relative; height: {TALL}px">{below}'
            f'<iframe srcdoc="{html.escape(self.html)}" style="{frame}"></iframe></div>'
        )

    def _picture(self) -> str:
        from scenegen.display.figures import draw_completions
        from scenegen.display.panels import plain, to_bytes
        from scenegen.display.pictures import draw_sample

        look = self.looks[0]
        title = plain(look.name)
        figure = (
            draw_completions([look], title=title)
            if look.guesses
            else draw_sample(look, title=title)
        )
        drawn = to_bytes(figure, ".webp")
        return f"data:image/webp;base64,{base64.b64encode(drawn).decode()}"


def show(
    samples: Sample | Sequence[Sample],
    prediction: Any = None,
    path: Any = None,
    *,
    out: str | Path | None = None,
    grid: GridSpec | None = None,
    lidar: Sensor | None = None,
) -> Shown:
    """Show samples in three dimensions, and what was predicted of the first of them.

    In a notebook the page shows as the value of its cell; elsewhere it is opened in a browser, or
    written to the file `out`.

    Args:
        samples: One sample, or several.
        prediction: What is predicted of the first sample: a `scenegen.Prediction`, or a bool array
            of occupied voxels; or several of them by the name of who predicts.
        path: Points (n, 3) of a path planned on the first of the predictions, or on the truth,
            metres in the world.
        out: The page's file.
        grid: The map's grid. A dataset's sample knows its own; others need it.
        lidar: The sensor. A dataset's or a stream's sample knows its own.

    Raises:
        DatasetError: The grid is not known, or too large for a page; a prediction or path does not
            fit the map; or `out` is not ours to replace.
        TypeError: The sensor is not known.
    """
    looks = []
    for sample in [samples] if isinstance(samples, Sample) else samples:
        its_grid = grid or sample.grid
        if its_grid is None:
            raise DatasetError("this sample does not know its grid; give grid, such as recipe.grid")
        name = f"world {sample.world}, viewpoint {sample.viewpoint}"
        looks.append(look_at(sample, its_grid, lidar, name))
    if not looks:
        raise DatasetError("no samples to show; give one, or several")
    first = looks[0]
    predictions: Mapping[str, Any] = {"prediction": prediction}
    if isinstance(prediction, Mapping | None):
        predictions = prediction or {}
    if path is not None and not predictions:
        predictions = {"truth": first.masks["occupancy"]}
    if clashing := predictions.keys() & first.masks.keys():  # a name is one layer
        raise DatasetError(f"prediction: {', '.join(clashing)}: a sample's own; give another name")
    guesses = [_guess(name, predicted, first.grid) for name, predicted in predictions.items()]
    if path is not None:
        guesses[0] = replace(guesses[0], route=_route(path))
    looks[0] = replace(first, guesses=tuple(guesses))
    notes = [line for look in looks for line in look.missing]
    shown = Shown(html=page(looks, title="scenegen", notes=notes), looks=looks)
    if out is not None:
        write_result(Path(out), shown.html.encode())
    elif "ipykernel" not in sys.modules:
        with tempfile.NamedTemporaryFile(prefix="scenegen-", suffix=".html", delete=False) as file:
            file.write(shown.html.encode())
        webbrowser.open(Path(file.name).as_uri())
    return shown


def _guess(name: str, found: Any, grid: GridSpec) -> Guess:
    """A prediction, or occupied voxels, to be shown. The thresholds of a prediction are the
    paper's."""
    told = hasattr(found, "occupied")
    parts = [found.occupancy_probability, found.tudf] if told else []
    if not all(np.isfinite(part).all() for part in parts if part is not None):
        raise DatasetError(f"{name}: holds NaN or infinity; expected a number in every voxel")
    occupied = np.asarray(found.occupied() if told else found)
    if occupied.shape != grid.shape or occupied.dtype != bool:
        raise DatasetError(
            f"{name}: an array {occupied.dtype} {occupied.shape}; expected occupied voxels, bool "
            f"{grid.shape}, or a scenegen.Prediction of this map"
        )
    from scenegen.truth import distance_field  # which compiles

    tudf = found.distance(None, grid) if told else distance_field(occupied, grid)
    return Guess(name=name, occupied=occupied, tudf=tudf)


def _route(path: Any) -> Route:
    points = np.asarray(path, float)
    if points.shape[1:] != (3,) or not len(points) or not np.isfinite(points).all():
        raise DatasetError(f"path: an array {points.shape}; expected (n, 3), metres in the world")
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return Route(start=points[0], goal=points[-1], points=points, told=f"{length:.2f} m")
