"""Classes of voxels by how they were seen, and the obstacles that returned something."""

import dataclasses
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from lidarsim import AnalyticEngine, Sensor
from lidarsim.grid import Field, GridSpec, Mask
from lidarsim.scan import Scan
from lidarsim.solids import Solids
from lidarsim.voxelization import fuse
from scenegen.dataset.read import AnyDataset, Split
from scenegen.draw.sample import Sample
from scenegen.draw.scored import certain_distances, scored_voxels
from scenegen.model.completion.protocol import Prediction
from scenegen.truth import distance_field, rasterize
from scenegen.worlds.world import solid

CLASSES = ("observed", "crossed", "occluded", "interior", "out_of_view")
"""How a voxel was seen. An `observed` voxel holds a return. A `crossed` one holds none, and some
ray passes through it. All others are unknown: an `interior` voxel is occupied, and so are its six
neighbours; an `occluded` one lies on the way of some ray that ended before it; an `out_of_view` one
lies on the way of none."""
UNOBSERVED = tuple(CLASSES.index(name) for name in ("occluded", "interior", "out_of_view"))
"""The classes of unknown voxels: neither observed nor crossed."""
UNSCORED = 255
"""Stands in place of a class where a voxel lies below the ground, or where nobody knows what is
there: no score counts it."""


def walled(
    occupied: Mask,
    distance: Field,
    known: Mask | None,
    grid: GridSpec,
) -> tuple[Mask, Field]:
    """Close a map for plans that keep to known space: unknown voxels are as solid as occupied ones.

    Args:
        occupied: Collision map (*grid.shape).
        distance: Distances (*grid.shape), metres.
        known: Known voxels (*grid.shape); None: all.
        grid: The grid.

    Returns:
        The collision map and the distances, closed.
    """
    if known is None:
        return occupied, distance
    return occupied | ~known, np.minimum(distance, distance_field(~known, grid))


def classify(
    sample: Sample,
    *,
    grid: GridSpec,
    scored: Mask | None = None,
    lidar: Sensor | None = None,
) -> NDArray[np.uint8]:
    """Classify every voxel of a sample by how it was seen.

    Args:
        sample: The sample.
        grid: Its grid.
        scored: Voxels that count (*grid.shape); None: all.
        lidar: The sensor of a sample that does not know its own.

    Returns:
        (*grid.shape): an index into `CLASSES`, or `UNSCORED` where a voxel does not count.
    """
    in_view = within_view(sample, grid, lidar)
    classes = np.where(
        in_view, np.uint8(CLASSES.index("occluded")), np.uint8(CLASSES.index("out_of_view"))
    )
    six = ndimage.generate_binary_structure(3, 1)
    # beyond the map counts as occupied: otherwise a wall at the border would have no interior
    inside = ndimage.binary_erosion(sample.occupancy, six, border_value=1)
    classes[inside] = CLASSES.index("interior")
    # later lines win: a voxel that a ray crossed is seen, however solid its surroundings
    classes[sample.free] = CLASSES.index("crossed")
    classes[sample.observed] = CLASSES.index("observed")
    if scored is not None:
        classes[~scored] = UNSCORED
    return classes


@dataclasses.dataclass(frozen=True)
class Case:
    """A sample with the truth and the classes that all methods are measured by, computed once, when
    first used. Maps are (*grid.shape)."""

    sample: Sample
    index: int
    """The sample's in its split."""
    split: Split

    @property
    def grid(self) -> GridSpec:
        """The map's."""
        return self.split.dataset.grid

    @cached_property
    def classes(self) -> NDArray[np.uint8]:
        """How each voxel was seen; see `classify`."""
        scored = scored_voxels(self.sample, self.grid, self.split.home(self.index).tables.world)
        return classify(self.sample, grid=self.grid, scored=scored)

    @cached_property
    def certain(self) -> Mask | None:
        """See `certain_distances`."""
        return certain_distances(self.sample.tudf, self.sample.known, self.grid)

    @cached_property
    def truth(self) -> tuple[Mask, Field]:
        """Ground truth for paths, in which unknown voxels are as solid as occupied ones; and its
        distance field, metres."""
        sample = self.sample
        return walled(sample.occupancy, sample.tudf, sample.known, self.grid)


class Seen:
    """The truth of the obstacles that returned something, as if it had been predicted.

    It is no upper bound: it lacks all other obstacles, of which a network can guess those that are
    usual in such worlds, such as walls of the next room."""

    name = "seen"
    learned = False

    def completion(self, sample: Sample, split: Split) -> Prediction:
        """See `Method.completion`.

        Args:
            sample: The sample.
            split: Its split.

        Returns:
            The occupancy of these obstacles, whose transform is the distance.

        Raises:
            DatasetError: The sample's world cannot be compiled.
        """
        return Prediction(occupancy_probability=seen_occupancy(sample, split).astype(np.float32))


@lru_cache(maxsize=1)  # every method on a sample asks for the same
def seen_occupancy(sample: Sample, split: Split) -> Mask:
    """Rasterize the obstacles that returned at least one of a sample's rays, anywhere.

    An obstacle is a geom of the world. A dataset stores ranges only, so the rays are cast anew in
    the archived world to find the geoms that they met. Rays without a stored return count as none.

    Args:
        sample: The sample.
        split: Its split.

    Returns:
        (*grid.shape): voxels that touch such an obstacle.

    Raises:
        DatasetError: The world cannot be compiled.
    """
    dataset = split.dataset
    solids, engine = _world(dataset, split.name, int(sample.world))
    scans = sample.scans()
    origins = np.array([scan.pose.position for scan in scans])
    directions = np.array([scan.directions for scan in scans])
    # rays without a stored return are dropped below: noise and range may have taken them
    hits = engine.hits(origins, directions, scans[0].lidar.max_range_m)
    geoms = hits.geoms[np.isfinite([scan.ranges for scan in scans])]
    return rasterize(some_of(solids, np.unique(geoms)), dataset.grid, sample.origin)


def some_of(solids: Solids, geoms: ArrayLike) -> Solids:
    """Select solids by their geoms.

    Args:
        solids: The solids.
        geoms: Numbers of the geoms to keep, (k,).

    Returns:
        The solids of these geoms.
    """
    # primitives come first in `geom`, then meshes, whose triangles lie one after the other
    chosen = np.isin(solids.geom, geoms)
    plain, meshes = np.split(chosen, [len(solids.shape)])
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
        geom=solids.geom[chosen],
    )


@lru_cache(maxsize=2)  # the samples of a world come one after the other
def _world(dataset: AnyDataset, split: str, number: int) -> tuple[Solids, AnalyticEngine]:
    """Compile an archived world: its solids, and the engine that casts rays in it."""
    solids = solid(dataset.compile(split, number), f"{split} world {number}").solids
    return solids, AnalyticEngine(solids, threads=1)


def within_view(sample: Sample, grid: GridSpec, sensor: Any) -> Mask:
    """Find the voxels that a sample's rays would cross if nothing returned.

    Args:
        sample: The sample.
        grid: Its grid.
        sensor: The sensor of a sample that does not know its own.

    Returns:
        (*grid.shape).
    """
    # rays that end nowhere reach every voxel in view
    endless = [
        Scan(np.full_like(scan.ranges, np.inf), scan.pose, scan.lidar)
        for scan in sample.scans(sensor)
    ]
    return fuse(endless, grid, sample.origin).free
