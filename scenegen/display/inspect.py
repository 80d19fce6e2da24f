"""What is in a dataset, in a folder of datasets, or in a world: counts, sizes, statistics, what
does not fit, and a page of it for a browser."""

import base64
import html
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim import GridSpec, Sensor
from lidarsim.engines.voxels import VoxelMap
from scenegen import SPLITS
from scenegen.dataset.choose import FIGURES
from scenegen.dataset.manifest import NAME
from scenegen.dataset.read import Dataset, Split
from scenegen.dataset.trust import load
from scenegen.display.look import looks, spread
from scenegen.errors import DatasetError, printable
from scenegen.run.workers import run
from scenegen.stores.cache import bytes_in

SHAPES = (
    "planes",
    "height fields",
    "spheres",
    "capsules",
    "ellipsoids",
    "cylinders",
    "boxes",
    "meshes",
)
"""What MuJoCo's codes of shapes stand for."""
AT_ONCE = 200
"""Samples that a process measures before it tells of them."""
MOST_MEASURED = 200
"""Samples of a split that are measured, unless all are."""
MOST_LISTED = 1000
"""The most datasets of a list."""
MOST_BEYOND = 0.4
"""The share of a map beyond its sensor's range from which on it is told; of the presets' maps it is
0.06."""


def inspect(
    folder: Path,
    *,
    most: int | None = MOST_MEASURED,
    values: bool = False,
    workers: int = 1,
    on_start: Callable[[int], None] = lambda samples: None,
    on_done: Callable[[int], None] = lambda samples: None,
) -> dict[str, Any]:
    """Sums a dataset up.

    Args:
        folder: The dataset.
        most: Samples of a split that are measured, evenly spread; None for all.
        values: Whether every split has the figures of the measured samples, too.
        workers: Processes that measure.
        on_start: Called with the number of samples that are measured, once processes run.
        on_done: Called with the number of every few.

    Returns:
        Plain JSON values. Statistics are {mean, std, min, max} over samples of shares of all voxels
        or of all rays, and of metres; None where no sample has the figure.

    Raises:
        DatasetError: The folder holds no dataset, or a damaged one.
    """
    dataset = Dataset(folder, partial=True)
    it = dataset.manifest
    found = {
        "kind": it.kind,
        "seed": it.seed,
        "complete": it.complete,
        "digest": it.digest,
        "fields": list(it.fields),
        "grid": it.parameters["grid"],
        "rejected": it.rejected,
        "mapping": it.parameters.get("mapping"),
    }
    if it.sources:
        found["sources"] = [
            {
                **{"kind": one.kind, "seed": one.seed, "digest": one.digest},
                "taken": entry["taken"],
                "samples": {
                    split: sum(
                        shard.samples
                        for shard in it.shards
                        if it.home(shard) is one and shard.split == split
                    )
                    for split in SPLITS
                },
            }
            for one, entry in zip(it.sources, it.parameters["sources"], strict=True)
        ]
    splits = [split for split in map(dataset.split, SPLITS) if len(split)]
    tasks = [(split.name, part) for split in splits for part in _parts(split, most)]
    measured: list[Rows] = [{}] * len(tasks)
    begun = partial(on_start, sum(len(part) for _, part in tasks))
    with closing(run(partial(_measure, dataset), enumerate(tasks), workers, begun)) as results:
        for number, rows in results:
            measured[number] = rows
            on_done(len(tasks[number][1]))
    told = {}
    for split in splits:
        mine = [n for n, (name, _) in enumerate(tasks) if name == split.name]
        rows = {name: np.concatenate([measured[n][name] for n in mine]) for name in FIGURES}
        told[split.name] = {
            "samples": len(split),
            "worlds": split.count_worlds(),
            "sampled": sum(len(tasks[n][1]) for n in mine),
            "statistics": {name: _spread(row) for name, row in rows.items()},
            **({"values": {name: row.tolist() for name, row in rows.items()}} if values else {}),
        }
    size, samples = bytes_in(folder), sum(map(len, splits))
    sizes = {"bytes": size, "bytes_per_sample": size / max(samples, 1)}
    return {**found, "samples": samples, **sizes, "splits": told}


Rows = dict[str, NDArray[np.float64]]
"""Figures of samples by name; a sample that lacks one is left out."""


def _parts(split: Split, most: int | None) -> list[NDArray[np.int64]]:
    """Indices of the samples that are measured, some at a time."""
    count = len(split)
    asked = count if most is None else min(most, count)
    found = np.unique(np.linspace(0, count - 1, asked).astype(int))
    return np.split(found, range(AT_ONCE, len(found), AT_ONCE))


def _measure(dataset: Dataset, task: tuple[int, tuple[str, NDArray[np.int64]]]) -> tuple[int, Rows]:
    """The number of a task, and the figures of its samples."""
    number, (name, chosen) = task
    split = dataset.split(name)
    rows = []
    for index in chosen.tolist():
        sample = split[index]
        rows.append([figure(sample) for figure in FIGURES.values()])
    columns = np.array(rows, dtype=np.float64).T
    return number, {
        name: column[~np.isnan(column)] for name, column in zip(FIGURES, columns, strict=True)
    }


def _spread(values: NDArray[np.float64]) -> dict[str, float | None]:
    """How numbers spread."""
    if not len(values):
        return dict.fromkeys(("mean", "std", "min", "max"))
    found = {"mean": values.mean(), "std": values.std(), "min": values.min(), "max": values.max()}
    return {name: float(value) for name, value in found.items()}


def inspect_all(folder: Path) -> list[dict[str, Any]]:
    """A line for each dataset in a folder's folders: its `folder`, and its kind, samples and
    digest, or its `fault`."""
    found = []
    for path in sorted(folder.glob(f"*/{NAME}"))[:MOST_LISTED]:
        row: dict[str, Any] = {"folder": str(path.parent)}
        try:
            it = load(path.parent)
            samples = {
                name: sum(one.samples for one in it.shards if one.split == name) for name in SPLITS
            }
            row |= {
                "kind": it.kind,
                "samples": samples,
                "complete": it.complete,
                "digest": it.digest,
            }
        except DatasetError as error:
            row["fault"] = printable(error)
        found.append(row)
    return found


def inspect_world(path: Path) -> dict[str, Any]:
    """What stands in the world of an MJCF file, or what a map of a real place knows of it. Raises
    SceneError for a file that cannot serve."""
    from scenegen.source import read_world  # which loads what compiles worlds
    from scenegen.worlds.place import Place

    world = read_world(path)
    if isinstance(world, Place):
        bounds = {"flight_bounds": world.flight_bounds.tolist()}
        return {"map": str(path)} | map_facts(world.voxels) | bounds
    codes, counts = np.unique(world.solids.shape, return_counts=True)
    solids = {SHAPES[int(code)]: int(count) for code, count in zip(codes, counts, strict=True)}
    if len(world.solids.mesh_filled):
        solids["meshes"] = len(world.solids.mesh_filled)
    return {
        "world": str(path),
        "solids": solids,
        "triangles": len(world.solids.triangles),
        "flight_bounds": world.flight_bounds.tolist(),
        "unseen": list(world.unseen),
    }


def map_facts(voxels: VoxelMap) -> dict[str, Any]:
    """How large a map of a real place is, and which shares of its voxels are known."""
    states = np.bincount(voxels.states.reshape(-1), minlength=3) / voxels.states.size
    return {
        "voxel_m": voxels.voxel_m,
        "shape": list(voxels.states.shape),
        "bounds": voxels.bounds.tolist(),
        **dict(zip(("unknown", "free", "occupied"), states.tolist(), strict=True)),
    }


def misfits(grid: GridSpec, lidar: Sensor) -> list[str]:
    """What of a map its sensor can hardly know, in a line each."""
    edges = [np.linspace(-extent / 2, extent / 2, 41) for extent in grid.extent_m]
    x, y, z = np.meshgrid(*edges, indexing="ij", sparse=True)
    beyond = float((x * x + y * y + z * z > lidar.max_range_m**2).mean())
    if beyond <= MOST_BEYOND:
        return []
    return [
        f"{100 * beyond:.0f} % of the map lie beyond the sensor's {lidar.max_range_m:g} m: "
        f"nothing is ever seen there; take a smaller grid, or a sensor that sees farther"
    ]


SHOWN, BINS = 8, 24
"""Samples in the picture of a split, and bars of a histogram."""
LABELS = {
    "occupied": ("voxels occupied", "%", 100),
    "observed": ("voxels observed", "%", 100),
    "free": ("voxels known to be free", "%", 100),
    "returned": ("rays that return", "%", 100),
    "range_m": ("mean range", "m", 1),
    "tudf_m": ("mean distance", "m", 1),
    "clearance_m": ("distance to the nearest obstacle", "m", 1),
    "visibility_m": ("mean visibility", "m", 1),
    "dispersion": ("dispersion", "%", 100),
    "passage_m": ("narrowest passage", "m", 1),
    "tortuosity": ("tortuosity", "", 1),
    "traversability": ("traversability", "", 1),
}
"""Statistics of a sample: what they are called, their unit, and the factor to it."""
HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<style>
body { font: 15px/1.45 system-ui, sans-serif; color: #1b1f24; background: #fff;
  margin: 0 auto; padding: 1rem; max-width: 70rem; }
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
    """The page of what `inspect` gives with `values`. No text of the dataset is taken for HTML."""
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
            for key, (label, unit, factor) in LABELS.items()
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
