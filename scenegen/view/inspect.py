"""Summarizes datasets, folders of datasets, worlds and scans: counts, sizes, statistics."""

import json
from collections.abc import Iterable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np

from lidarsim import Sensor
from lidarsim.engines.voxels import VoxelMap
from lidarsim.grid import Floats, GridSpec
from scenegen import SPLITS
from scenegen.base.errors import DatasetError, printable
from scenegen.base.executors import Counted, unheard
from scenegen.base.files import Json, write_atomic
from scenegen.base.mirrors import bytes_in
from scenegen.base.workers import run
from scenegen.dataset.collection import open_data
from scenegen.dataset.manifest import load
from scenegen.dataset.read import AnyDataset, Dataset, Split
from scenegen.dataset.schema import NAME, ShardEntry
from scenegen.dataset.selection import (
    MEASURES,
    OF_WORLD,
    encode_measures,
    kept_measures,
    measure_of,
    measures_file,
)
from scenegen.view.look import evenly
from scenegen.worlds.clouds import read_cloud

MAX_MEASURED = 200
"""Samples of a split that are measured by default."""
MAX_BEYOND = 0.4
"""Share of a map beyond its sensor's range above which `misfits` warns; presets have 0.06."""


def inspect(
    dataset: AnyDataset,
    *,
    most: int | None = MAX_MEASURED,
    keep: bool = False,
    workers: int = 1,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
) -> Json:
    """Summarize a dataset.

    Args:
        dataset: A dataset, a collection or a selection.
        most: Maximum samples of a split to measure, evenly spread; None for all. Ignored if the
            dataset's measures are stored beside it.
        keep: Measure all samples, and store beside the dataset their measures, see `measures_file`,
            and the returned `splits` as JSON.
        workers: Processes that measure.
        on_start: Called with the number of samples to measure, once processes run.
        on_done: Called with 1 after each sample.

    Returns:
        Plain JSON values. Statistics are {mean, std, min, max} over samples, of shares of all
        voxels or rays, or of metres; None if no sample has the measure. A split of several kinds
        has them for each in `kinds`; a split measured completely has in `world_means` those of the
        means over the samples of a world.

    Raises:
        DatasetError: A sample or a manifest is damaged; or `keep` for anything but one complete
            dataset.
    """
    datasets = [_facts(part) for part in dataset.datasets]
    first, *further = datasets
    summary = first if not further else {"datasets": datasets, "digest": dataset.digest}
    if keep and not isinstance(dataset, Dataset):
        raise DatasetError(
            f"{dataset.name}: measures are stored beside one dataset; inspect each of its datasets"
        )
    # stored measures are found by the digest, which an incomplete dataset does not have yet
    if keep and not dataset.datasets[0].manifest.complete:
        raise DatasetError(f"{dataset.name}: incomplete; give the command that made it again")
    # without stored measures, measure some samples of each split
    splits = [split for split in map(dataset.split, SPLITS) if len(split)]
    tasks, tables = [], kept_measures(dataset)
    for split in splits if not tables else ():
        chosen = evenly(len(split), (not keep and most) or len(split))
        # filled as results come: workers finish in any order
        tables[split.name] = np.empty((len(chosen), len(MEASURES)))
        tasks += [(split.name, *row) for row in enumerate(chosen)]
    # `run` calls it once all workers are forked: a progress bar starts a thread
    begun = partial(on_start, len(tasks))
    # closed, so that an error in this block leaves no worker behind
    with closing(run(partial(_measure, dataset), tasks, workers, begun)) as results:
        for name, row, measures in results:
            tables[name][row] = measures
            on_done(1)
    if keep and tasks:
        write_atomic(
            measures_file(dataset.datasets[0]),
            encode_measures(np.concatenate(list(tables.values()))),
        )
    about_splits = {split.name: _split_facts(split, tables[split.name]) for split in splits}
    if keep:
        content = json.dumps(about_splits, indent=1).encode()
        write_atomic(measures_file(dataset.datasets[0]).with_suffix(".json"), content)
    size = sum(bytes_in(part.folder) for part in dataset.datasets)
    samples = sum(map(len, splits))
    return {
        **summary,
        "samples": samples,
        "bytes": size,
        "bytes_per_sample": size / max(samples, 1),
        "splits": about_splits,
    }


def inspect_path(path: Path) -> Json:
    """Summarize the dataset, collection or selection at a path, see `inspect`. Raises
    DatasetError."""
    # the samples that an unfinished run has made so far can be inspected
    return inspect(open_data(path, partial=True))


def _facts(dataset: Dataset) -> Json:
    """Return facts of a dataset from its manifest."""
    manifest = dataset.manifest
    return {
        "name": dataset.name,
        "kind": manifest.graded,
        "seed": manifest.seed,
        "complete": manifest.complete,
        "digest": manifest.digest,
        "rejected": manifest.rejected,
        "fields": list(manifest.fields),
        "grid": manifest.tables.grid,
        "mapping": manifest.tables.mapping,
        "lidar": str(manifest.lidar),
        "noise": manifest.noise_stages,
        "samples_of": _counts(manifest.shards),
    }


def _split_facts(split: Split, table: Floats) -> Json:
    """Return the size of a split, and statistics of its measures (samples, measures)."""
    row = {
        "samples": len(split),
        "worlds": split.count_worlds(),
        "sampled": len(table),
        "statistics": _statistics(table),
    }
    # a world's mean takes all of its samples
    if len(table) == len(split):
        first_of_world = np.unique(split.numbers[0], return_index=True)[1]
        means = [measure_of(split, table, OF_WORLD + name)[first_of_world] for name in MEASURES]
        row["world_means"] = _statistics(np.transpose(means))
    if len({part.kind for part in split.dataset.datasets}) > 1:
        row["kinds"] = _by_kind(split, table)
    return row


def _measure(dataset: AnyDataset, task: tuple[str, int, int]) -> tuple[str, int, list[float]]:
    """Measure the sample of a task (split, row, index). Return split, row and measures; NaN for a
    measure that the sample lacks."""
    split, row, index = task
    sample = dataset.split(split)[index]
    return split, row, [measure(sample) for measure in MEASURES.values()]


def _statistics(table: Floats) -> Json:
    """Return statistics of measures (samples, measures), by the names of `MEASURES`."""
    statistics: Json = {}
    for name, column in zip(MEASURES, table.T, strict=True):
        values = column[~np.isnan(column)]  # NaN: the sample lacks the measure
        # None, since JSON has no NaN
        statistics[name] = {
            how: float(getattr(values, how)()) if len(values) else None
            for how in ("mean", "std", "min", "max")
        }
    return statistics


def _by_kind(split: Split, table: Floats) -> Json:
    """Return for each kind how many samples were measured, and their statistics."""
    # rows of the table are those samples that `inspect` chose by the same call
    chosen = evenly(len(split), len(table))
    rows = {kind: table[np.isin(chosen, numbers)] for kind, numbers in split.by_kind().items()}
    return {
        kind: {"sampled": len(measured), "statistics": _statistics(measured)}
        for kind, measured in rows.items()
        if len(measured)
    }


def _counts(shards: Iterable[ShardEntry]) -> dict[str, int]:
    """Return the number of samples of each split."""
    counts = dict.fromkeys(SPLITS, 0)
    for shard in shards:
        counts[shard.split] += shard.samples
    return counts


def inspect_all(folder: Path) -> list[Json]:
    """Return a row for each dataset in the folders of a folder: its `folder`, and its kind, samples
    and digest, or the `fault` of a dataset that cannot be read."""
    rows = []
    for path in sorted(folder.glob(f"*/{NAME}")):
        row: Json = {"folder": str(path.parent)}
        try:
            manifest = load(path.parent)
            row |= {
                "kind": manifest.graded,
                "complete": manifest.complete,
                "digest": manifest.digest,
                "samples": _counts(manifest.shards),
            }
        # one damaged dataset must not hide the others
        except DatasetError as error:
            row["fault"] = printable(error)
        rows.append(row)
    return rows


def inspect_world(path: Path) -> Json:
    """Return the solids and bounds of a world in an MJCF file, or facts of a map of a real place.
    Raises SceneError if the file cannot be read as either."""
    from scenegen.draw.source import read_world  # loads MuJoCo
    from scenegen.worlds.drawing import SHAPES
    from scenegen.worlds.place import Place

    world = read_world(path)
    bounds = {"flight_bounds": world.flight_bounds.tolist()}
    if isinstance(world, Place):
        return {"map": str(path)} | map_facts(world.voxels) | bounds
    codes, counts = np.unique(world.solids.shape, return_counts=True)
    solids = {SHAPES[int(code)]: int(count) for code, count in zip(codes, counts, strict=True)}
    if len(world.solids.mesh_filled):
        solids["mesh"] = len(world.solids.mesh_filled)
    return {
        "world": str(path),
        "solids": solids,
        "triangles": len(world.solids.triangles),
        "unseen": list(world.unseen),
    } | bounds


def map_facts(voxels: VoxelMap) -> Json:
    """Return size and bounds of a map of a real place, and the shares of its states."""
    states = ("unknown", "free", "occupied")  # UNKNOWN, FREE and OCCUPIED, by number
    return {
        "voxel_m": voxels.voxel_m,
        "shape": list(voxels.states.shape),
        "bounds": voxels.bounds.tolist(),
        **{name: float((voxels.states == n).mean()) for n, name in enumerate(states)},
    }


def scan_facts(path: Path, columns: int | None = None) -> Json:
    """Return facts of a file of points: how it was read, counts, bounds and ranges.

    Args:
        path: The file.
        columns: Columns of a file without a header, see `read_cloud`.

    Raises:
        DatasetError: The file cannot be read.
    """
    cloud = read_cloud(path, columns=columns)
    points = cloud.points
    returned = points[np.isfinite(points).all(axis=1)]
    facts = {"scan": str(path), "read": cloud.layout, "points": len(points)}
    facts |= {"returns": len(returned), "at_origin": int((~returned.any(axis=1)).sum())}
    if len(returned):
        ranges = np.linalg.norm(returned, axis=1)
        facts |= {
            "lower_m": returned.min(axis=0).tolist(),
            "upper_m": returned.max(axis=0).tolist(),
            "mean_range_m": float(ranges.mean()),
            "max_range_m": float(ranges.max()),
        }
    return facts


def misfits(grid: GridSpec, lidar: Sensor) -> list[str]:
    """Check that a map fits its sensor.

    Args:
        grid: The map, with the sensor at its centre.
        lidar: The sensor.

    Returns:
        Warnings, a line each: if much of the map is beyond the sensor's range.
    """
    edges = [np.linspace(-extent / 2, extent / 2, 41) for extent in grid.extent_m]
    x, y, z = np.meshgrid(*edges, indexing="ij", sparse=True)
    share = float((x * x + y * y + z * z > lidar.max_range_m**2).mean())
    if share <= MAX_BEYOND:
        return []
    return [
        f"{100 * share:.0f} % of the map lie beyond the sensor's {lidar.max_range_m:g} m: "
        f"nothing is ever seen there; take a smaller grid, or a sensor of longer range"
    ]


TITLES = {
    "occupied": ("voxels occupied", "%"),
    "observed": ("voxels that hold a return", "%"),
    "free": ("voxels known to be free", "%"),
    "unknown": ("voxels unknown", "%"),
    "returned": ("rays that return", "%"),
    "range_m": ("mean range of the returns", "m"),
    "tudf_m": ("mean distance to an occupied voxel", "m"),
    "clearance_m": ("distance from the sensor to an obstacle", "m"),
    "visibility_m": ("mean distance seen from the sensor", "m"),
    "dispersion": ("neighbouring directions, one of them blocked", "%"),
    "passage_m": ("narrowest passage at the sensor", "m"),
    "tortuosity": ("length of the path out, of that without obstacles", ""),
    "traversability": ("mean way to an obstacle", "robot diameters"),
    "gap": ("mean width of passages", "robot diameters"),
    "ghosts": ("voxels with a return of some scan, and nothing now", ""),
    "movers_seen": ("movers with a return", ""),
    "mover_returns": ("returns on movers", ""),
}
"""Names and units of the measures, for people; shares are shown in %."""


def titles(splits: Json) -> dict[str, tuple[str, str]]:
    """Return the `TITLES` of the measures that some split has; see `inspect`."""
    measured = [split["statistics"] for split in splits.values()]
    return {
        key: title
        for key, title in TITLES.items()
        if any(statistics[key]["mean"] is not None for statistics in measured)
    }
