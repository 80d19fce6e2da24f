"""Samples with predictions and paths, or a file, as a page in a notebook, a file, or a browser."""

import base64
import html
import importlib.util
import os
import sys
import tempfile
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import GridSpec, Sensor
from scenegen.base.errors import DatasetError
from scenegen.base.files import write_result
from scenegen.base.paths import TYPES, function_for, what_is
from scenegen.dataset.locate import locate
from scenegen.draw.sample import Sample
from scenegen.view.look import Guess, Look, Route, look_at
from scenegen.view.page import page

TALL = 620
"""Height of a page in a notebook, pixels."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shown:
    """What `show` shows; a notebook shows it as the last value of a cell."""

    html: str
    """The page."""
    looks: Sequence[Look]
    """The samples on it; none of a picture."""
    draw: Callable[[], Any]
    """Draws a figure of the first of them."""

    def __repr__(self) -> str:
        return f"<Shown: {', '.join(look.name for look in self.looks) or 'a picture'}>"

    def _repr_html_(self) -> str:
        """The page in a frame; below it a picture of the first sample, which is what one sees where
        frames or scripts are not to be had, as on GitHub."""
        if importlib.util.find_spec("matplotlib") is None:
            below = "<p>A picture where no scripts run needs matplotlib: the extra view.</p>"
        else:
            below = picture(self.draw())
        frame = "position: absolute; inset: 0; width: 100%; height: 100%; border: 0"
        return (
            f'<div style="position: relative; height: {TALL}px">{below}'
            f'<iframe srcdoc="{html.escape(self.html)}" style="{frame}"></iframe></div>'
        )


def picture(figure: Any) -> str:
    """A figure as an element of a page."""
    from scenegen.view.panels import to_bytes

    content = base64.b64encode(to_bytes(figure, ".webp")).decode()
    style = "max-width: 100%; max-height: 100%"
    return f'<img src="data:image/webp;base64,{content}" style="{style}">'


def _draw(look: Look) -> Any:
    from scenegen.view.figures import draw_completions
    from scenegen.view.panels import plain
    from scenegen.view.pictures import draw_sample

    title = plain(look.name)
    return draw_completions([look], title=title) if look.guesses else draw_sample(look, title=title)


def show(
    samples: Sample | Sequence[Sample] | str | os.PathLike[str],
    prediction: Any = None,
    path: Any = None,
    *,
    out: str | Path | None = None,
    grid: GridSpec | None = None,
    lidar: Sensor | None = None,
) -> Shown:
    """Show samples in three dimensions, and what was predicted of the first of them; or a path.

    In a notebook the page shows as the value of its cell; elsewhere it is opened in a browser, or
    written to the file `out`.

    Args:
        samples: One sample, or several; or the path of a dataset, of which some samples are shown,
            of the completion of a scan, or of anything that `scenegen render` draws, as a picture.
        prediction: What is predicted of the first sample: a `scenegen.Prediction`, or a bool array
            of occupied voxels; or several of them by the name of who predicts.
        path: Points (n, 3) of a path planned on the first of the predictions, or on the truth,
            metres in the world.
        out: The page's file.
        grid: The map's grid. A dataset's sample knows its own; others need it.
        lidar: The sensor. A dataset's or a stream's sample knows its own.

    Raises:
        DatasetError: The grid is not known, or too large for a page; a prediction or path does not
            fit the map; a path is not known, or cannot be shown; or `out` is not ours to replace.
        TypeError: The sensor is not known.
    """
    if isinstance(samples, str | os.PathLike):
        name = os.fspath(samples)
        if not TYPES[what_is(name)].shows:
            figure = function_for(name, "draws")(Path(name))
            title = f"<title>{html.escape(name)}</title>"
            drawn = Shown(html=title + picture(figure), looks=(), draw=lambda: figure)
            return _open(drawn, out)
        looks = function_for(name, "shows")(locate(name))
    else:
        several = [samples] if isinstance(samples, Sample) else samples
        looks = [_look(sample, grid or sample.grid, lidar) for sample in several]
    if not looks:
        raise DatasetError("no samples to show; give one, or several")
    looks[0] = _with_guesses(looks[0], prediction, path)
    notes = [line for look in looks for line in look.missing]
    content = page(looks, title="scenegen", notes=notes)
    return _open(Shown(html=content, looks=looks, draw=partial(_draw, looks[0])), out)


def _look(sample: Sample, grid: GridSpec | None, lidar: Sensor | None) -> Look:
    if grid is None:
        raise DatasetError("this sample does not know its grid; give grid, such as recipe.grid")
    return look_at(sample, grid, lidar, f"world {sample.world}, viewpoint {sample.viewpoint}")


def _with_guesses(look: Look, prediction: Any, path: Any) -> Look:
    """A sample with what is predicted of it; for the arguments see `show`."""
    predictions: Mapping[str, Any] = {"prediction": prediction}
    if isinstance(prediction, Mapping | None):
        predictions = prediction or {}
    if path is not None and not predictions:
        predictions = {"truth": look.masks["occupancy"]}
    if clashing := predictions.keys() & look.masks.keys():  # a name is one layer
        raise DatasetError(f"prediction: {', '.join(clashing)}: a sample's own; give another name")
    guesses = [_guess(name, predicted, look.grid) for name, predicted in predictions.items()]
    if path is not None:
        guesses[0] = replace(guesses[0], route=_route(path))
    return replace(look, guesses=(*look.guesses, *guesses))


def _open(shown: Shown, out: str | Path | None) -> Shown:
    """Write a page to a file, or open it in a browser unless a notebook shows it."""
    if out is not None:
        write_result(Path(out), shown.html.encode())
    elif "ipykernel" not in sys.modules:
        with tempfile.NamedTemporaryFile(prefix="scenegen-", suffix=".html", delete=False) as file:
            file.write(shown.html.encode())
        webbrowser.open(Path(file.name).as_uri())
    return shown


def _guess(name: str, predicted: Any, grid: GridSpec) -> Guess:
    """A prediction, or occupied voxels, to be shown. The thresholds of a prediction are the
    paper's."""
    is_prediction = hasattr(predicted, "occupied")
    arrays = [predicted.occupancy_probability, predicted.tudf] if is_prediction else []
    if not all(np.isfinite(array).all() for array in arrays if array is not None):
        raise DatasetError(f"{name}: holds NaN or infinity; expected a number in every voxel")
    occupied = np.asarray(predicted.occupied() if is_prediction else predicted)
    if occupied.shape != grid.shape or occupied.dtype != bool:
        raise DatasetError(
            f"{name}: an array {occupied.dtype} {occupied.shape}; expected occupied voxels, bool "
            f"{grid.shape}, or a scenegen.Prediction of this map"
        )
    from scenegen.truth import distance_field  # which compiles

    tudf = predicted.distance(None, grid) if is_prediction else distance_field(occupied, grid)
    return Guess(name=name, occupied=occupied, tudf=tudf)


def _route(path: Any) -> Route:
    points = np.asarray(path, float)
    if points.shape[1:] != (3,) or not len(points) or not np.isfinite(points).all():
        raise DatasetError(f"path: an array {points.shape}; expected (n, 3), metres in the world")
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return Route(start=points[0], goal=points[-1], points=points, told=f"{length:.2f} m")
