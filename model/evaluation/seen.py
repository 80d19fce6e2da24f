"""What of the truth the sensor had a chance to know: the obstacles that returned something,
whole."""

import dataclasses
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarsim import AnalyticEngine
from lidarsim.solids.shapes import Solids
from scenegen.dataset.extract import compile_archived
from scenegen.dataset.read import Dataset, Split
from scenegen.model.completion.protocol import Prediction
from scenegen.sample import Sample
from scenegen.truth import rasterize


class Seen:
    """The truth of the obstacles that returned something, as if it had been predicted: the ceiling
    of any completion, for of the other obstacles a scan says nothing."""

    name = "seen"
    learned = False

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`. Raises DatasetError where the sample's world cannot be
        compiled."""
        return Prediction(occupancy_probability=seen_occupancy(sample, split).astype(np.float32))


def seen_occupancy(sample: Sample, split: Split) -> NDArray[np.bool_]:
    """The voxels (*grid.shape) that touch an obstacle, a geom of the world, that returned at least
    one of the sample's rays, wherever it did so.

    Which geom a ray met is found by casting anew in the archived world: a dataset stores ranges
    alone. Rays without a stored return count as none. Raises DatasetError where the world cannot be
    compiled.
    """
    dataset = split.dataset
    solids, engine = _world(dataset.folder, split.name, int(sample.world))
    scans = sample.scans()
    origins, directions = (
        np.array([scan.pose.position for scan in scans]),
        np.array([scan.directions for scan in scans]),
    )
    hits = engine.hits(origins, directions, dataset.lidar.max_range_m)
    geoms = hits.geoms[np.isfinite([scan.ranges for scan in scans])]
    return rasterize(some_of(solids, np.unique(geoms)), dataset.grid, sample.origin)


def some_of(solids: Solids, geoms: ArrayLike) -> Solids:
    """Those of `solids` whose numbers are among `geoms` (k,)."""
    kept = np.isin(solids.geom, geoms)
    plain, meshes = np.split(kept, [len(solids.shape)])
    sizes = np.diff(solids.mesh_start)
    arrays = {
        name: getattr(solids, name)[plain]
        for name in ("shape", "size", "position", "rotation", "lower", "upper")
    }
    return dataclasses.replace(
        solids,
        **arrays,
        triangles=solids.triangles[np.repeat(meshes, sizes)],
        mesh_start=np.cumsum([0, *sizes[meshes]]),
        mesh_filled=solids.mesh_filled[meshes],
        geom=solids.geom[kept],
    )


@lru_cache(maxsize=2)  # the samples of a world come one after the other
def _world(folder: Path, split: str, number: int) -> tuple[Solids, AnalyticEngine]:
    """The solids of an archived world, and what casts rays in it."""
    solids = compile_archived(Dataset(folder), split, number).solids
    return solids, AnalyticEngine(solids, threads=1)
