"""Input channels of networks, by name.

A *named batch* maps names of inputs to arrays. Data, training, validation, completion and export
hand it on as it is. One more channel is a function (seen, grid, sensor) → (*grid.shape), where
`seen` is a dataset's sample or a `PointScan`: an entry of `INPUTS` in config.py, or a user's own as
module:function, in the `NetworkConfig` of the network that takes it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.grid import Field, Floats, GridSpec, Ints, Mask
from lidarsim.voxelization import sort_points
from scenegen.base.errors import DatasetError, own_code
from scenegen.draw.sample import Sample
from scenegen.model.config import INPUTS, import_named, is_own
from scenegen.truth import distance_field

SYMMETRIES = 8
"""Rotations by quarter turns about the sensor's vertical axis, each with and without a mirror."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointScan:
    """A single scan, the observations of a map without a dataset.

    `observed`, `free`, `origin` and `position` are named as a sample's.
    """

    points: Floats
    """(N, 3): returns within `MAX_LENGTH_M` of the origin, metres, in a level frame."""
    position: Floats
    """(3,): where the sensor is in that frame, metres."""
    grid: GridSpec

    @cached_property
    def origin(self) -> Floats:
        """The map's least corner (3,) in the scan's frame, metres."""
        return self.grid.origin_at(self.position)

    @cached_property
    def voxels(self) -> Ints:
        """(M, 3): the voxel of every point that lies in the map."""
        index = self.grid.index(self.points, self.origin)
        return index[((index >= 0) & (index < self.grid.shape)).all(axis=1)]

    @cached_property
    def observed(self) -> Mask:
        """(*grid.shape): the voxels of the points."""
        observed = np.zeros(self.grid.shape, bool)
        observed[tuple(self.voxels.T)] = True
        return observed

    @cached_property
    def free(self) -> Mask:
        """(*grid.shape): voxels that rays with a return crossed; points do not tell other rays."""
        # a dataset's `free` has the rays without a return, too: see `UNTOLD`
        crossed = sort_points(self.position, self.points, self.grid, self.origin).free
        return crossed & ~self.observed


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenMap:
    """A map without its truth, which the bench and robots pass to inputs and methods. Positions are
    metres in the world."""

    observed: Mask
    """(*grid.shape): voxels that hold a return."""
    free: Mask
    """(*grid.shape): voxels that a ray crossed, without the observed ones."""
    origin: Floats
    """(3,): the map's least corner."""
    position: Floats
    """(3,): of the sensor."""
    quaternion: Floats
    """(4,): w, x, y, z, from the axes of the body to those of the world."""
    lidar: Any = None
    """The sensor, as far as it is known."""

    @classmethod
    def of(cls, sample: Sample) -> "SeenMap":
        """Copy the seen part of a sample: a method may write to its arguments."""
        names = ("observed", "free", "origin", "position", "quaternion")
        return cls(**{name: getattr(sample, name).copy() for name in names}, lidar=sample.lidar)


Channel = Callable[[Any, GridSpec, Any], NDArray[Any]]
"""Function that computes one channel: (sample or scan, grid, sensor or None) → (*grid.shape). Of a
dataset's sample, only the fields that it accesses are read."""
BINARY = ("observed", "free")
"""Channels in which every voxel holds 0 or 1; others hold finite numbers."""
UNTOLD = {
    "free": "of rays without a return nothing is known, so less is free than in training",
}
"""Messages on channels that differ if a map is computed from points only."""


def observed(seen: Any, grid: GridSpec, sensor: Any) -> Mask:
    """Channel of the voxels that hold a return.

    Args:
        seen: A sample, `PointScan` or `SeenMap`.
        grid: Its grid.
        sensor: The sensor; not used.

    Returns:
        Mask (*grid.shape).
    """
    return seen.observed


def free(seen: Any, grid: GridSpec, sensor: Any) -> Mask:
    """Channel of the voxels that a ray crossed, without the observed ones.

    Args:
        seen: A sample, `PointScan` or `SeenMap`.
        grid: Its grid.
        sensor: The sensor; not used.

    Returns:
        Mask (*grid.shape).
    """
    return seen.free


def distance(seen: Any, grid: GridSpec, sensor: Any) -> Field:
    """Channel of the distances to the nearest observed voxel.

    Args:
        seen: A sample, `PointScan` or `SeenMap`.
        grid: Its grid.
        sensor: The sensor; not used.

    Returns:
        (*grid.shape): metres, at most the truncation.
    """
    return distance_field(seen.observed, grid)


@cache
def input_called(name: str) -> Channel:
    """Import an input. The channels of a user's own are checked.

    Args:
        name: Its name.

    Returns:
        The function, the same object on every call.

    Raises:
        ScenegenError: There is no such input.
    """
    function = import_named(INPUTS, name)
    if not is_own(name):
        return function

    def checked(seen: Any, grid: GridSpec, sensor: Any) -> Field:
        """Compute the channel, and check it.

        Args:
            seen: A sample, `PointScan` or `SeenMap`.
            grid: Its grid.
            sensor: The sensor, or None.

        Returns:
            (*grid.shape), float32.

        Raises:
            OwnCodeError: The user's code failed.
            DatasetError: It is not a map of finite numbers.
        """
        expected = f"expected finite numbers of shape {grid.shape}"
        # a loader process hands over no traceback
        with own_code(f"input {name}: {expected} from a function (seen, grid, sensor)"):
            values = np.asarray(function(seen, grid, sensor), np.float32)
        if values.shape != grid.shape or not np.isfinite(values).all():
            raise DatasetError(f"input {name}: gives an array of shape {values.shape}, {expected}")
        return values

    return checked


def channels(
    names: Sequence[str], seen: Any, grid: GridSpec, sensor: Any = None
) -> dict[str, NDArray[Any]]:
    """Compute the inputs of a map.

    Args:
        names: Names of inputs.
        seen: A sample, `PointScan` or `SeenMap`.
        grid: Its grid.
        sensor: The sensor, or None.

    Returns:
        (*grid.shape) each, by name.
    """
    return {name: input_called(name)(seen, grid, sensor) for name in names}


def points_of(sample: Sample, grid: GridSpec, sensor: Any) -> PointScan | None:
    """Return the points of a sample as a scan; None unless it is one scan in the map's middle.

    Args:
        sample: The sample.
        grid: Its grid.
        sensor: The sensor.

    Returns:
        The scan, or None.
    """
    scan = PointScan(points=sample.points(sensor), position=sample.position, grid=grid)
    # several scans, or a map ahead of the sensor, cannot be had from one cloud of points
    single = sample.earlier_ranges is None and np.array_equal(scan.origin, sample.origin)
    return scan if single else None


def turned(grid: NDArray[Any], symmetry: int) -> NDArray[Any]:
    """Turn a map about z by quarter turns, and mirror it.

    The sensor's place, the centre, stays where it is. Odd turns need a map as long in x as in y.

    Args:
        grid: (..., X, Y, Z).
        symmetry: 0 to 7: `symmetry` % 4 quarter turns, mirrored in y from 4 on.

    Returns:
        The map, contiguous, (..., X, Y, Z).
    """
    # not about x or y: worlds stand on the ground
    if symmetry >= SYMMETRIES // 2:
        grid = grid[..., ::-1, :]
    return np.ascontiguousarray(np.rot90(grid, symmetry % 4, axes=(-3, -2)))
