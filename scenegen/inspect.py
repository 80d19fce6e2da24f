"""What is in a dataset: counts, sizes, and statistics of what was seen and what is there."""

from pathlib import Path
from typing import Any

import numpy as np

from scenegen import SPLITS
from scenegen.dataset.read import Dataset
from scenegen.sample import Sample


def inspect(folder: Path, *, most: int = 200) -> dict[str, Any]:
    """A summary of the dataset in `folder`; statistics are taken over at most `most` samples a split, evenly spread.

    Shares are of all voxels or of all rays, {mean, std, min, max} over samples, None where no sample has the figure.
    Raises DatasetError.
    """
    dataset = Dataset(folder, partial=True)
    it = dataset.manifest
    found = {
        **{"kind": it.kind, "seed": it.seed, "complete": it.complete, "digest": it.digest, "fields": list(it.fields)},
        **{"grid": it.parameters["grid"], "rejected": it.rejected, "mapping": it.parameters.get("mapping")},
    }
    splits: dict[str, Any] = {}
    for name in SPLITS:
        split = dataset.split(name)
        if len(split):
            splits[name] = _describe(dataset, name, most)
    size = sum(path.stat().st_size for path in folder.iterdir() if path.is_file())
    samples = sum(split["samples"] for split in splits.values())
    return {**found, "samples": samples, "bytes": size, "bytes_per_sample": size / max(samples, 1), "splits": splits}


def _describe(dataset: Dataset, name: str, most: int) -> dict[str, Any]:
    split = dataset.split(name)
    chosen = np.unique(np.linspace(0, len(split) - 1, min(most, len(split))).astype(int))
    rows = [_figures(split[int(index)]) for index in chosen]
    statistics = {key: _statistics([row[key] for row in rows if row[key] == row[key]]) for key in rows[0]}
    return {
        "samples": len(split),
        "worlds": len({world for _, world, _ in split.names}),
        "sampled": len(chosen),
        "statistics": statistics,
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
