"""A dataset's statistics as one HTML page without scripts: tables, histograms, and a few
samples."""

import base64
import html
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from scenegen.dataset.read import Dataset
from scenegen.display.look import looks, spread
from scenegen.errors import DatasetError

SHOWN, BINS = 8, 24
"""Samples in the picture of a split, and bars of a histogram."""
FIGURES = {
    "occupied": ("voxels occupied", "%", 100),
    "observed": ("voxels observed", "%", 100),
    "free": ("voxels known to be free", "%", 100),
    "returned": ("rays that return", "%", 100),
    "range_m": ("mean range", "m", 1),
    "tudf_m": ("mean distance", "m", 1),
}
"""Statistics of a sample: what they are called, their unit, and the factor to it."""
HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<style>
body { font: 15px/1.45 system-ui, sans-serif; color: #1b1f24; background: #fff; margin: 0 auto; padding: 1rem;
  max-width: 70rem; }
dl { display: grid; grid-template-columns: auto 1fr; gap: 0 1rem; }
dd { margin: 0; overflow-wrap: anywhere; }
.charts { display: flex; flex-wrap: wrap; gap: 1rem; }
figure { margin: 0; flex: 1 1 18rem; max-width: 24rem; }
figcaption { font-weight: 600; }
small { color: #59636e; }
svg, img { width: 100%; height: auto; }
.note { color: #8a2b00; }
</style>
"""


def statistics_page(dataset: Dataset, found: Mapping[str, Any], notes: Sequence[str]) -> str:
    """The page of what `scenegen.display.inspect.inspect` gives with `values`. No text of the dataset is
    taken for HTML."""
    title = f"{dataset.folder.name}: {found['kind']}"
    grid = dataset.grid
    about = {
        "seed": found["seed"],
        "digest": found["digest"] or "incomplete",
        "grid": f"{' × '.join(map(str, grid.shape))} voxels of {grid.voxel_m:g} m",
        "sensor": dataset.lidar,
        "samples": found["samples"],
        "size": f"{found['bytes'] / 1e6:.1f} MB, {found['bytes_per_sample'] / 1e3:.1f} KB a sample",
    }
    parts = [f"<title>{_text(title)}</title></head><body><h1>{_text(title)}</h1>"]
    parts += [f"<p class='note'>{_text(line)}</p>" for line in notes]
    parts.append(
        "<dl>"
        + "".join(f"<dt>{name}</dt><dd>{_text(value)}</dd>" for name, value in about.items())
        + "</dl>"
    )
    for name, split in found["splits"].items():
        parts.append(
            f"<h2>{_text(name)}</h2><p>{split['samples']} samples of {split['worlds']} worlds; "
            f"{split['sampled']} "
            "were measured.</p><div class='charts'>"
        )
        parts += [
            _histogram(label, unit, np.array(split["values"][key]) * factor)
            for key, (label, unit, factor) in FIGURES.items()
        ]
        parts.append(f"</div>{_picture(dataset, name)}")
    return f"{HEAD}{''.join(parts)}</body></html>\n"


def _histogram(label: str, unit: str, values: Any) -> str:
    if not len(values):
        return ""
    counts, edges = np.histogram(values, BINS)
    bars = "".join(
        f"<rect x='{10 + 12.5 * n:.1f}' y='{100 - 90 * count / counts.max():.1f}' width='11.5' "
        f"height='{90 * count / counts.max():.1f}' fill='#1560bd'/>"
        for n, count in enumerate(counts)
    )
    ends = "".join(
        f"<text x='{x}' y='115' text-anchor='{anchor}' font-size='12'>{edge:.3g} {unit}</text>"
        for x, anchor, edge in ((10, "start", edges[0]), (310, "end", edges[-1]))
    )
    return (
        f"<figure><figcaption>{_text(label)}</figcaption>"
        f"<svg viewBox='0 0 320 120' role='img' aria-label='{_text(label)}'>{bars}{ends}</svg>"
        f"<small>{values.mean():.2f} ± {values.std():.2f} {unit}, at most {counts.max()} samples a "
        "bar</small></figure>"
    )


def _picture(dataset: Dataset, split: str) -> str:
    """A sheet of samples; none without matplotlib, or where none can be read."""
    if find_spec("matplotlib") is None:
        return ""
    from scenegen.display.panels import to_bytes
    from scenegen.display.pictures import draw_sheet

    try:
        shown, _ = looks(dataset, split, spread(dataset, split, SHOWN))
        image = to_bytes(draw_sheet(shown, title=""), ".webp")
    except DatasetError:
        return ""
    content = base64.b64encode(image).decode()
    return f"<img alt='{SHOWN} samples of {_text(split)}' src='data:image/webp;base64,{content}'>"


def _text(value: object) -> str:
    return html.escape(str(value))
