"""Shows samples with predictions and paths, or a file, in a notebook, a file, or a browser."""

import base64
import html
import importlib.util
import os
import sys
import tempfile
import webbrowser
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import GridSpec, Sensor
from lidarsim.parameters import short_repr
from scenegen.base.errors import DatasetError, reraise_as
from scenegen.base.files import write_result
from scenegen.base.paths import TYPES, check_type, function_for, what_is
from scenegen.dataset.locate import locate
from scenegen.draw.sample import Sample
from scenegen.view.look import Guess, Look, PlannedPath, look_at
from scenegen.view.page import page

TALL = 620
"""Height of the page in a notebook, pixels."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shown:
    """The result of `show`, which notebooks display as the value of a cell."""

    html: str
    """Content of the page."""
    looks: Sequence[Look]
    """Samples on the page; empty for a picture."""
    draw: Callable[[], Any]
    """Function that draws the first sample by matplotlib."""

    def __repr__(self) -> str:
        return f"<Shown: {', '.join(look.name for look in self.looks) or 'a picture'}>"

    def _repr_html_(self) -> str:
        """Return the page in a frame, in front of a picture of the first sample. The picture shows
        wherever frames or scripts are blocked, as on GitHub."""
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
    """Return a figure as an HTML element."""
    from scenegen.view.stills import to_bytes

    content = base64.b64encode(to_bytes(figure, ".png")).decode()
    style = "max-width: 100%; max-height: 100%"
    return f'<img src="data:image/png;base64,{content}" style="{style}">'


def _draw(look: Look) -> Any:
    from scenegen.view.stills import draw

    return draw([look], title=look.name)


def show(
    samples: Sample | Sequence[Sample] | str | os.PathLike[str],
    prediction: Any = None,
    path: Any = None,
    *,
    out: str | Path | None = None,
    grid: GridSpec | None = None,
    lidar: Sensor | None = None,
) -> Shown:
    """Show samples in three dimensions, with predictions and a path for the first of them.

    A notebook displays the returned value. Elsewhere the page opens in a browser, or is written to
    `out`.

    Args:
        samples: A sample, or several; or a path: of a dataset, a scan, a log, a map, a world, a
            completed scan, or of anything that `scenegen render` draws.
        prediction: Prediction for the first sample: a `scenegen.Prediction`, or a bool array of
            occupied voxels, of the grid's shape; or a dictionary of these by the name of a method.
        path: Points (n, 3) of a path planned on the first prediction, or on the truth, metres in
            the world.
        out: File for the page.
        grid: Grid of the map; needed for samples that are not of a dataset.
        lidar: The sensor; needed for samples that are not of a dataset or stream.

    Returns:
        The page, its samples, and a function that draws the first.

    Raises:
        DatasetError: The grid is not known, or too large for a page; a prediction or path does not
            fit the map; a file does not exist, or cannot be shown; or `out` may not be replaced.
        TypeError: The sensor is not known.
    """
    if isinstance(samples, str | os.PathLike):
        name = os.fspath(samples)
        if prediction is None and path is None:
            return _open(page_of(name), out)
        looks = function_for(name, "shows")(locate(name))
    else:
        several: Any = samples if isinstance(samples, Iterable) else [samples]
        looks = [_look(sample, grid, lidar) for sample in several]
    if not looks:
        raise DatasetError("no samples to show; give one, or several")
    looks[0] = _with_guesses(looks[0], prediction, path)
    notes = [line for look in looks for line in look.missing]
    content = page(looks, title="scenegen", notes=notes)
    return _open(Shown(html=content, looks=looks, draw=partial(_draw, looks[0])), out)


def page_of(name: str, **options: Any) -> Shown:
    """Make the page of whatever a path is.

    Args:
        name: A path of a type in `TYPES` that can be shown or drawn.
        options: Arguments of the function that shows this type.

    Raises:
        DatasetError: The path does not exist, or has no type, or one that cannot be shown.
    """
    path_type = TYPES[what_is(name)]
    check_type(name, *(known for known, kind in TYPES.items() if kind.shows or kind.draws))
    if not path_type.shows:
        figure = function_for(name, "draws")(Path(name))
        title = f"<title>{html.escape(name)}</title>"
        return Shown(html=title + picture(figure), looks=(), draw=lambda: figure)
    looks = function_for(name, "shows")(locate(name), **options)
    notes = [line for look in looks for line in look.missing]
    content = page(looks, title=Path(name).name, notes=notes, film=path_type.film)
    drawn = path_type.draws and not looks[0].guesses
    draw = partial(function_for(name, "draws"), Path(name)) if drawn else partial(_draw, looks[0])
    return Shown(html=content, looks=looks, draw=draw)


def _look(sample: Sample, grid: GridSpec | None, lidar: Sensor | None) -> Look:
    if not isinstance(sample, Sample):
        raise DatasetError(
            f"show({short_repr(sample)}): expected a sample, several, or a path; for a sensor in a "
            "simulation, see scenegen.view_live"
        )
    if (grid := grid or sample.grid) is None:
        raise DatasetError("this sample does not know its grid; give grid, such as recipe.grid")
    return look_at(sample, grid, lidar, f"world {sample.world}, viewpoint {sample.viewpoint}")


def _with_guesses(look: Look, prediction: Any, path: Any) -> Look:
    """Add predictions and a path to a sample; for the arguments see `show`."""
    predictions: Mapping[str, Any] = {"prediction": prediction}
    if isinstance(prediction, Mapping | None):
        predictions = prediction or {}
    # a page draws paths on a prediction: for a path alone, the truth is one
    if path is not None and not predictions:
        known = "occupancy" if "occupancy" in look.masks else "observed"
        predictions = {"truth" if known == "occupancy" else "seen": look.masks[known]}
    if clashing := predictions.keys() & look.masks.keys():  # a page has one layer a name
        raise DatasetError(
            f"prediction: {', '.join(clashing)}: a sample's own layer; give another name"
        )
    guesses = [_guess(name, predicted, look.grid) for name, predicted in predictions.items()]
    if path is not None:
        guesses[0] = replace(guesses[0], route=_route(path))
    return replace(look, guesses=(*look.guesses, *guesses))


def _open(result: Shown, out: str | Path | None) -> Shown:
    """Write a page to a file, or open it in a browser unless a notebook shows it."""
    if out is not None:
        # another name may be of a scan or of weights, which a page would replace
        name = str(out)
        if "://" in name or not name.endswith(".html"):
            raise DatasetError(f"{name}: expected a file on this machine that ends in .html")
        write_result(Path(out), result.html.encode())
    elif "ipykernel" not in sys.modules:  # not within a notebook
        # not deleted: the browser may read it after this process has ended
        with tempfile.NamedTemporaryFile(prefix="scenegen-", suffix=".html", delete=False) as file:
            file.write(result.html.encode())
        webbrowser.open(Path(file.name).as_uri())
    return result


def _guess(name: str, predicted: Any, grid: GridSpec) -> Guess:
    """Check a prediction, or occupied voxels, and make a `Guess`. A prediction is thresholded as in
    the paper."""
    # by its method: the class is of `model`, which imports this package
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
    from scenegen.truth import distance_field  # compiles: not for those who only show samples

    tudf = predicted.distance(None, grid) if is_prediction else distance_field(occupied, grid)
    chance = predicted.chance if is_prediction else None
    return Guess(name=name, occupied=occupied, tudf=tudf, chance=chance)


def _route(path: Any) -> PlannedPath:
    """Check the points of a path, and make a `PlannedPath`."""
    with reraise_as(DatasetError, "path: ", of=(TypeError, ValueError)):
        points = np.asarray(path, float)
    if points.shape[1:] != (3,) or not len(points) or not np.isfinite(points).all():
        raise DatasetError(f"path: an array {points.shape}; expected (n, 3), metres in the world")
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return PlannedPath(start=points[0], goal=points[-1], points=points, told=f"{length:.2f} m")
