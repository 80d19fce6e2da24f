"""Samples in a browser, by one call."""

import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import GridSpec, Sensor
from scenegen.display.look import Guess, look_at
from scenegen.display.page import page
from scenegen.errors import DatasetError
from scenegen.files import write_result
from scenegen.sample import Sample
from scenegen.truth import distance_field


def show(
    samples: Sample | Sequence[Sample],
    predictions: Mapping[str, Any] | None = None,
    *,
    out: str | Path | None = None,
    grid: GridSpec | None = None,
    lidar: Sensor | None = None,
) -> Path:
    """Show samples in three dimensions, and what was predicted of them, on a page of one file.

    Args:
        samples: One sample, or several.
        predictions: What is predicted of the first sample, by the name of who predicts it: a
            `scenegen.Prediction`, or a bool array of occupied voxels.
        out: The page's file. By default, a temporary file that is opened in a browser.
        grid: The map's grid. A dataset's sample knows its own; others need it.
        lidar: The sensor. A dataset's or a stream's sample knows its own.

    Returns:
        The page's file.

    Raises:
        DatasetError: The grid is not known, or too large for a page; or `out` is not ours to
            replace.
        TypeError: The sensor is not known.
    """
    several = [samples] if isinstance(samples, Sample) else list(samples)
    looks = []
    for sample in several:
        its_grid = grid or getattr(sample, "grid", None)
        if its_grid is None:
            raise DatasetError("this sample does not know its grid; give grid, such as recipe.grid")
        its_lidar = lidar or sample.scans()[0].lidar
        name = f"world {sample.world}, viewpoint {sample.viewpoint}"
        looks.append(look_at(sample, its_grid, its_lidar, name))
    guesses = [_guess(name, found, looks[0].grid) for name, found in (predictions or {}).items()]
    looks[0] = replace(looks[0], guesses=tuple(guesses))
    notes = [line for look in looks for line in look.missing]
    content = page(looks, title="scenegen", notes=notes).encode()
    if out is not None:
        write_result(Path(out), content)
        return Path(out)
    with tempfile.NamedTemporaryFile(prefix="scenegen-", suffix=".html", delete=False) as file:
        file.write(content)
    webbrowser.open(Path(file.name).as_uri())
    return Path(file.name)


def _guess(name: str, found: Any, grid: GridSpec) -> Guess:
    """A prediction, or occupied voxels, to be shown. The thresholds of a prediction are the
    paper's."""
    if isinstance(found, np.ndarray):
        return Guess(name=name, occupied=found, tudf=distance_field(found, grid))
    return Guess(name=name, occupied=found.occupied(), tudf=found.distance(None, grid))
