"""What is in a dataset, in a folder of datasets, or in a world: counts, sizes, statistics, and what does not fit."""

from pathlib import Path
from typing import Any

import numpy as np

from lidarsim import GridSpec, Sensor
from scenegen import SPLITS
from scenegen.dataset.manifest import NAME
from scenegen.dataset.read import Dataset
from scenegen.dataset.trust import load
from scenegen.errors import DatasetError, printable
from scenegen.sample import Sample

SHAPES = ("planes", "height fields", "spheres", "capsules", "ellipsoids", "cylinders", "boxes", "meshes")
"""What MuJoCo's codes of shapes stand for."""
MOST_LISTED = 1000
"""The most datasets of a list."""
MOST_BEYOND = 0.4
"""The share of a map beyond its sensor's range from which on it is told; of the presets' maps it is 0.06."""


def inspect(folder: Path, *, most: int = 200, values: bool = False) -> dict[str, Any]:
    """A summary of the dataset in `folder`; statistics are taken over at most `most` samples a split, evenly spread.

    Shares are of all voxels or of all rays, {mean, std, min, max} over samples, None where no sample has the figure.
    With `values`, every split has those of the measured samples, too, by figure. Raises DatasetError.
    """
    dataset = Dataset(folder, partial=True)
    it = dataset.manifest
    found = {
        **{"kind": it.kind, "seed": it.seed, "complete": it.complete, "digest": it.digest, "fields": list(it.fields)},
        **{"grid": it.parameters["grid"], "rejected": it.rejected, "mapping": it.parameters.get("mapping")},
    }
    if it.sources:
        found["sources"] = [
            {"kind": one.kind, "seed": one.seed, "digest": one.digest, "taken": entry["taken"]}
            for one, entry in zip(it.sources, it.parameters["sources"], strict=True)
        ]
    splits: dict[str, Any] = {}
    for name in SPLITS:
        split = dataset.split(name)
        if len(split):
            splits[name] = _describe(dataset, name, most, values)
    size = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
    samples = sum(split["samples"] for split in splits.values())
    return {**found, "samples": samples, "bytes": size, "bytes_per_sample": size / max(samples, 1), "splits": splits}


def _describe(dataset: Dataset, name: str, most: int, values: bool) -> dict[str, Any]:
    split = dataset.split(name)
    chosen = np.unique(np.linspace(0, len(split) - 1, min(most, len(split))).astype(int))
    rows = [_figures(split[int(index)]) for index in chosen]
    measured = {key: [row[key] for row in rows if row[key] == row[key]] for key in rows[0]}
    statistics = {key: _statistics(found) for key, found in measured.items()}
    return {
        "samples": len(split),
        "worlds": len({world for _, world, _ in split.names}),
        "sampled": len(chosen),
        "statistics": statistics,
        **({"values": measured} if values else {}),
    }


def _figures(sample: Sample) -> dict[str, float]:
    ranges = np.array([sample.ranges, *getattr(sample, "earlier_ranges", ())])
    hit = np.isfinite(ranges)
    found = {"occupied": sample.occupancy.mean(), "observed": sample.observed.mean(), "free": sample.free.mean()}
    found |= {"returned": hit.mean(), "range_m": ranges[hit].mean() if hit.any() else np.nan}
    return {name: float(value) for name, value in (found | {"tudf_m": sample.tudf.mean()}).items()}


def _statistics(values: list[float]) -> dict[str, float | None]:
    if not values:
        return dict.fromkeys(("mean", "std", "min", "max"))
    return {"mean": float(np.mean(values)), "std": float(np.std(values)), "min": min(values), "max": max(values)}


def inspect_all(folder: Path) -> list[dict[str, Any]]:
    """A line for each dataset in a folder's folders: its `folder`, and its kind, samples and digest, or its `fault`."""
    found = []
    for path in sorted(folder.glob(f"*/{NAME}"))[:MOST_LISTED]:
        row: dict[str, Any] = {"folder": str(path.parent)}
        try:
            it = load(path.parent)
            samples = {name: sum(one.samples for one in it.shards if one.split == name) for name in SPLITS}
            row |= {"kind": it.kind, "samples": samples, "complete": it.complete, "digest": it.digest}
        except DatasetError as error:
            row["fault"] = printable(error)
        found.append(row)
    return found


def inspect_world(path: Path) -> dict[str, Any]:
    """What stands in the world of an MJCF file. Raises SceneError for one that cannot serve."""
    from scenegen.single import read_world  # which loads what compiles worlds

    world = read_world(path)
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


def misfits(grid: GridSpec, lidar: Sensor) -> list[str]:
    """What of a map its sensor can hardly know, in a line each."""
    half = np.array(grid.extent_m) / 2
    centres = np.stack(np.meshgrid(*(np.linspace(-edge, edge, 41) for edge in half), indexing="ij"), axis=-1)
    beyond = float((np.linalg.norm(centres, axis=-1) > lidar.max_range_m).mean())
    if beyond <= MOST_BEYOND:
        return []
    return [
        f"{100 * beyond:.0f} % of the map lie beyond the sensor's {lidar.max_range_m:g} m: nothing is ever seen there; "
        "take a smaller grid, or a sensor that sees farther"
    ]
