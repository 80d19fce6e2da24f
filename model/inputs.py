"""What a network can be shown of a map: every input channel, by name.

A *named batch* maps names of inputs to arrays. Data, training, validation, completion and export hand it on as it is:
one more channel is one more entry of `INPUTS`, and its name in the `NetworkConfig` of the network that takes it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import GridSpec
from lidarsim.limits import MOST_LENGTH_M
from lidarsim.pose import rotate
from lidarsim.scan import Scan
from lidarsim.voxelize import crossed, fuse
from scenegen.sample import Sample
from scenegen.truth import distance_field

SYMMETRIES = 8
"""Rotations by quarter turns about the sensor's vertical axis, each with and without a mirror."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointScan:
    """One scan alone: what is known of a map where there is no dataset."""

    points: NDArray[np.float64]
    """(N, 3): finite returns, metres, in a level frame."""
    sensor: NDArray[np.float64]
    """(3,): where the sensor is in that frame, metres."""
    grid: GridSpec

    @cached_property
    def origin(self) -> NDArray[np.float64]:
        """The map's least corner (3,) in the scan's frame, metres."""
        return self.grid.origin_at(self.sensor)

    @cached_property
    def voxels(self) -> NDArray[np.int64]:
        """(M, 3): the voxel of every point that lies in the map."""
        near = self.points[(np.abs(self.points) <= 2 * MOST_LENGTH_M).all(axis=1)]  # others have no whole numbers
        index = self.grid.index(near, self.origin)
        return index[((index >= 0) & (index < self.grid.shape)).all(axis=1)]


@dataclass(frozen=True, kw_only=True)
class Input:
    """One channel that a network may take."""

    of_sample: Callable[[Sample, GridSpec, Any], NDArray[Any]]
    """(sample, grid, sensor) → (*grid.shape). Of a dataset's sample, only the fields that this accesses are read."""
    of_scan: Callable[[PointScan], NDArray[Any]]
    """The same from one scan alone."""
    turns: bool = True
    """Whether the channel is turned with its map; one that is tied to the map's axes stays as it is."""
    binary: bool = True
    """Whether every voxel holds 0 or 1; other channels hold finite numbers."""
    untold: str = ""
    """What points alone do not tell of it, and what it then holds instead, for people."""


def _observed(scan: PointScan) -> NDArray[np.bool_]:
    observed = np.zeros(scan.grid.shape, dtype=np.bool_)
    observed[tuple(scan.voxels.T)] = True
    return observed


def _free(scan: PointScan) -> NDArray[np.bool_]:
    """Only of rays that returned something: points say nothing of the others."""
    return crossed(scan.sensor, scan.points, scan.grid, scan.origin) & ~_observed(scan)


def within_view(sample: Sample, grid: GridSpec, sensor: Any) -> NDArray[np.bool_]:
    """The voxels, (*grid.shape), that the sample's rays would cross if nothing returned."""
    endless = [Scan(np.full_like(scan.ranges, np.inf), scan.pose, scan.lidar) for scan in sample.scans(sensor)]
    return fuse(endless, grid, sample.origin).free


def _occluded(sample: Sample, grid: GridSpec, sensor: Any) -> NDArray[np.bool_]:
    return within_view(sample, grid, sensor) & ~sample.free & ~sample.observed


def _behind(scan: PointScan) -> NDArray[np.bool_]:
    """Beyond every return, to the map's end."""
    rays = scan.points - scan.sensor
    lengths = np.sqrt((rays * rays).sum(axis=1))
    there = (lengths > 0) & (lengths < MOST_LENGTH_M)
    reach = float(np.linalg.norm(scan.grid.extent_m) + np.linalg.norm(scan.sensor - scan.origin))
    ends = scan.sensor + rays[there] * (reach / lengths[there, None])
    return crossed(scan.sensor, ends, scan.grid, scan.origin) & ~_free(scan) & ~_observed(scan)


def _ahead(sample: Sample, grid: GridSpec, sensor: Any) -> NDArray[np.float32]:
    lines = [(np.arange(n) + 0.5) * grid.voxel_m for n in grid.shape]
    along = np.ix_(*(line + start for line, start in zip(lines, sample.origin - sample.position, strict=True)))
    forward = rotate(sample.quaternion, np.array([[1.0, 0.0, 0.0]]))[0]
    metres = np.sqrt(sum(part * part for part in along))
    return (sum(f * part for f, part in zip(forward, along, strict=True)) / np.maximum(metres, 1e-9)).astype(np.float32)


INPUTS = {
    "observed": Input(of_sample=lambda sample, grid, sensor: sample.observed, of_scan=_observed),
    "free": Input(
        of_sample=lambda sample, grid, sensor: sample.free,
        of_scan=_free,
        untold="of rays without a return nothing is known, so less is free than in training",
    ),
    "occluded": Input(of_sample=_occluded, of_scan=_behind),
    "distance": Input(
        of_sample=lambda sample, grid, sensor: distance_field(sample.observed, grid),
        of_scan=lambda scan: distance_field(_observed(scan), scan.grid),
        binary=False,
    ),
    "ahead": Input(
        of_sample=_ahead,
        of_scan=lambda scan: np.zeros(scan.grid.shape, np.float32),
        binary=False,
        untold="where the sensor faced is not known, so nothing lies ahead of it",
    ),
}
"""Every input by its name. `observed`: the voxels that hold a return. `free`: those that a ray crossed, less these.
`occluded`: those, less both, that lie on the way of a ray which ended before them. `distance`: metres to the nearest
observed voxel, at most the truncation. `ahead`: the cosine of the angle, seen from the sensor, between its forward axis
and the voxel."""


def of_sample(names: Sequence[str], sample: Sample, grid: GridSpec, sensor: Any) -> dict[str, NDArray[Any]]:
    """The inputs called `names`, (*grid.shape) each, from a sample."""
    return {name: INPUTS[name].of_sample(sample, grid, sensor) for name in names}


def of_scan(names: Sequence[str], scan: PointScan) -> dict[str, NDArray[Any]]:
    """The inputs called `names`, (*scan.grid.shape) each, from one scan alone."""
    return {name: INPUTS[name].of_scan(scan) for name in names}


def centres(observed: NDArray[np.bool_], grid: GridSpec) -> PointScan:
    """A scan that observes just the voxels `observed` (*grid.shape): a point at the centre of each, metres from the
    map's centre, where the sensor is."""
    sensor = np.zeros(3)
    return PointScan(points=grid.centres(grid.origin_at(sensor))[observed], sensor=sensor, grid=grid)


def turned(grid: NDArray[Any], symmetry: int) -> NDArray[Any]:
    """A map (X, Y, Z) turned by symmetry 0 to 7: `symmetry` % 4 quarter turns about z, mirrored in y from 4 on.

    The sensor's place, the centre, stays where it is. Odd turns need a map as long in x as in y.
    """
    if symmetry >= SYMMETRIES // 2:
        grid = grid[:, ::-1]
    return np.ascontiguousarray(np.rot90(grid, symmetry % 4, axes=(0, 1)))
