"""What is in a dataset, in a folder of datasets, or in a world: counts, sizes, statistics, and what
does not fit.
"""

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
from scenegen.base.files import Json, write_whole
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

MOST_MEASURED = 200
"""Samples of a split that are measured, unless all are."""
MOST_BEYOND = 0.4
"""The share of a map beyond its sensor's range from which on it is told; of the presets' maps it is
0.06."""


def inspect(
    dataset: AnyDataset,
    *,
    most: int | None = MOST_MEASURED,
    keep: bool = False,
    workers: int = 1,
    on_start: Counted = unheard,
    on_done: Counted = unheard,
) -> Json:
    """Sums a dataset up.

    Args:
        dataset: The dataset, the collection or the selection.
        most: Samples of a split that are measured, evenly spread; None for all. All count where
            their measures are kept beside them.
        keep: Measure all, and keep their measures there, see `measures_file`, and the `splits` that
            are returned, as JSON.
        workers: Processes that measure.
        on_start: Called with the number of samples that are measured, once processes run.
        on_done: Called with 1 for each.

    Returns:
        Plain JSON values. Statistics are {mean, std, min, max} over samples of shares of all voxels
        or of all rays, and of metres; None where no sample has the measure. A split has those of
        each of several kinds, too, in `kinds`, and, where all are measured, those of the means over
        the maps of a world in `world_means`.

    Raises:
        DatasetError: The folder holds no dataset, or a damaged one.
    """
    datasets = [_facts(one) for one in dataset.datasets]
    first, *others = datasets
    summary = first if not others else {"datasets": datasets, "digest": dataset.digest}
    if keep and not isinstance(dataset, Dataset):
        raise DatasetError(
            f"{dataset.name}: measures are kept beside one dataset; inspect each of its datasets"
        )
    if keep and not dataset.datasets[0].manifest.complete:
        raise DatasetError(f"{dataset.name}: incomplete; give the command that made it again")
    splits = [split for split in map(dataset.split, SPLITS) if len(split)]
    tasks, tables = [], kept_measures(dataset)
    for split in splits if not tables else ():
        chosen = evenly(len(split), (not keep and most) or len(split))
        tables[split.name] = np.empty((len(chosen), len(MEASURES)))
        tasks += [(split.name, *row) for row in enumerate(chosen)]
    begun = partial(on_start, len(tasks))
    with closing(run(partial(_measure, dataset), tasks, workers, begun)) as results:
        for name, row, measures in results:
            tables[name][row] = measures
            on_done(1)
    if keep and tasks:
        write_whole(
            measures_file(dataset.datasets[0]),
            encode_measures(np.concatenate(list(tables.values()))),
        )
    about_splits = {split.name: _about(split, tables[split.name]) for split in splits}
    if keep:
        content = json.dumps(about_splits, indent=1).encode()
        write_whole(measures_file(dataset.datasets[0]).with_suffix(".json"), content)
    size = sum(bytes_in(one.folder) for one in dataset.datasets)
    samples = sum(map(len, splits))
    return {
        **summary,
        "samples": samples,
        "bytes": size,
        "bytes_per_sample": size / max(samples, 1),
        "splits": about_splits,
    }


def inspect_path(path: Path) -> Json:
    """`inspect` of a dataset, a collection or a selection. Raises DatasetError."""
    return inspect(open_data(path, partial=True))


def _facts(dataset: Dataset) -> Json:
    """What the manifest of a dataset says of it."""
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


def _about(split: Split, table: Floats) -> Json:
    """The size of a split, and how the `MEASURES` of its samples (samples, measures) spread."""
    about = {
        "samples": len(split),
        "worlds": split.count_worlds(),
        "sampled": len(table),
        "statistics": _statistics(table),
    }
    if len(table) == len(split):
        first_of_world = np.unique(split.numbers[0], return_index=True)[1]
        means = [measure_of(split, table, OF_WORLD + name)[first_of_world] for name in MEASURES]
        about["world_means"] = _statistics(np.transpose(means))
    if len({one.kind for one in split.dataset.datasets}) > 1:
        about["kinds"] = _by_kind(split, table)
    return about


def _measure(dataset: AnyDataset, task: tuple[str, int, int]) -> tuple[str, int, list[float]]:
    """The split of a task, its row among those that are measured, and the measures of its sample;
    NaN where that lacks one."""
    split, row, index = task
    sample = dataset.split(split)[index]
    return split, row, [measure(sample) for measure in MEASURES.values()]


def _statistics(table: Floats) -> Json:
    """How the `MEASURES` of samples (samples, measures) spread."""
    statistics: Json = {}
    for name, column in zip(MEASURES, table.T, strict=True):
        values = column[~np.isnan(column)]
        statistics[name] = {
            how: float(getattr(values, how)()) if len(values) else None
            for how in ("mean", "std", "min", "max")
        }
    return statistics


def _by_kind(split: Split, table: Floats) -> Json:
    """For each kind, how many samples were measured, and how their measures spread."""
    chosen = evenly(len(split), len(table))
    rows = {kind: table[np.isin(chosen, numbers)] for kind, numbers in split.by_kind().items()}
    return {
        kind: {"sampled": len(measured), "statistics": _statistics(measured)}
        for kind, measured in rows.items()
        if len(measured)
    }


def _counts(shards: Iterable[ShardEntry]) -> dict[str, int]:
    """Samples of each split."""
    counts = dict.fromkeys(SPLITS, 0)
    for shard in shards:
        counts[shard.split] += shard.samples
    return counts


def inspect_all(folder: Path) -> list[Json]:
    """A line for each dataset in a folder's folders: its `folder`, and its kind, samples and
    digest, or its `fault`."""
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
        except DatasetError as error:
            row["fault"] = printable(error)
        rows.append(row)
    return rows


def inspect_world(path: Path) -> Json:
    """What stands in the world of an MJCF file, or what a map of a real place knows of it. Raises
    SceneError for a file that cannot serve."""
    from scenegen.draw.source import read_world  # which loads what compiles worlds
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
    """How large a map of a real place is, and which shares of its voxels are known."""
    states = ("unknown", "free", "occupied")  # UNKNOWN, FREE and OCCUPIED, by number
    return {
        "voxel_m": voxels.voxel_m,
        "shape": list(voxels.states.shape),
        "bounds": voxels.bounds.tolist(),
        **{name: float((voxels.states == n).mean()) for n, name in enumerate(states)},
    }


def scan_facts(path: Path, columns: int | None = None) -> Json:
    """A file of points: what it holds, how many, how far they reach, and how far away they are from
    its origin, see `read_cloud`. Raises DatasetError."""
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
    """Warnings, a line each: how much of a map lies beyond its sensor's range."""
    edges = [np.linspace(-extent / 2, extent / 2, 41) for extent in grid.extent_m]
    x, y, z = np.meshgrid(*edges, indexing="ij", sparse=True)
    beyond = float((x * x + y * y + z * z > lidar.max_range_m**2).mean())
    if beyond <= MOST_BEYOND:
        return []
    return [
        f"{100 * beyond:.0f} % of the map lie beyond the sensor's {lidar.max_range_m:g} m: "
        f"nothing is ever seen there; take a smaller grid, or a sensor that sees farther"
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
}
"""Statistics of a sample: what they are called, and their unit; shares are told in %."""
