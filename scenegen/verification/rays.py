"""A second opinion on stored ranges: rays cast anew by another engine, and how far noise may move
returns."""

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidarsim import GridSpec, Lidar, Sensor
from lidarsim.engines import Caster
from lidarsim.engines.voxels import LEAST_CHORD_M, OCCUPIED, VoxelMap
from lidarsim.grid import Field, Floats, Ints, Mask

SLACK_M = 2e-6
"""What float32 ranges and the slack of `occupancy` add to a bound."""


def count_strays(
    points: Floats,
    occupancy: Mask,
    grid: GridSpec,
    origin: Floats,
    bound_m: float,
) -> int:
    """How many of the returns `points` (M, 3), in the world, lie in the map and farther than
    `bound_m` from every occupied voxel, and from the map's faces, beyond which a solid may be."""
    inside, most, voxel = points - origin, bound_m + SLACK_M, grid.voxel_m
    extent = np.array(grid.shape) * voxel
    left = inside[((inside >= most) & (inside <= extent - most)).all(axis=1)]
    shape = np.array(grid.shape)
    shells = range(math.ceil(min(most / voxel, max(grid.shape))) + 1)
    for offset in itertools.chain.from_iterable(
        map(_shell, shells)
    ):  # nearest first: few points are left soon
        if not len(left):
            break
        cells = np.floor(left / voxel).astype(np.int64) + offset
        known = ((cells >= 0) & (cells < shape)).all(axis=1)
        gaps = np.maximum(np.maximum(cells * voxel - left, left - (cells + 1) * voxel), 0.0)
        near = known & ((gaps**2).sum(axis=1) <= most * most)
        near[near] = occupancy[tuple(cells[near].T)]
        left = left[~near]
    return len(left)


def _shell(reach: int) -> Ints:
    """The cells (n, 3) whose greatest coordinate is `reach`, whatever its sign."""
    cells = np.indices((2 * reach + 1,) * 3).reshape(3, -1).T - reach
    return np.asarray(cells[np.abs(cells).max(axis=1) == reach])


class MapAuditor:
    """Casts rays through a map of voxels in another way than `lidarsim.engines.voxels`: where a ray
    crosses planes between voxels is computed for all of them at once and sorted; the middle between
    two crossings tells the voxel."""

    def __init__(self, voxels: VoxelMap):
        self._voxels = voxels

    def cast(self, origins: ArrayLike, directions: ArrayLike, max_range_m: float) -> Floats:
        """See `lidarsim.engines.Caster.cast`."""
        pairs = zip(np.asarray(origins), np.asarray(directions), strict=True)
        return np.stack([self._from(start, rays, max_range_m) for start, rays in pairs])

    def _from(self, start: Floats, rays: Floats, max_range_m: float) -> Floats:
        states, voxel_m = self._voxels.states, self._voxels.voxel_m
        begin = (start - self._voxels.origin) / voxel_m
        reach, above = math.ceil(max_range_m / voxel_m) + 2, begin % 1
        found = np.full(len(rays), np.inf)
        several = max(MOST_CROSSINGS // reach, 1)
        for first in range(0, len(rays), several):
            some = rays[first : first + several] / voxel_m  # voxels a metre
            planes = np.where(some > 0, -above, above - 1)[..., None] + np.arange(reach)
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = (planes / np.abs(some)[..., None]).reshape(len(some), -1)
            # one behind the sensor, and those along which a ray runs, are no crossings
            stops = np.sort(np.clip(np.nan_to_num(ends), 0, 2 * reach * voxel_m))
            middle, way = (stops[:, 1:] + stops[:, :-1]) / 2, np.diff(stops)
            cells = np.floor(begin + middle[..., None] * some[:, None]).astype(np.int64)
            there: Any = ((cells >= 0) & (cells < states.shape)).all(axis=2)
            there[there] = states[tuple(cells[there].T)] == OCCUPIED
            there &= (way >= LEAST_CHORD_M) & (middle <= max_range_m)
            met = there.any(axis=1)
            found[first : first + several][met] = middle[met, there[met].argmax(axis=1)]
        return found


MOST_CROSSINGS = 200_000
"""Crossings along one axis that are computed at once."""
TOLERANCE_M = 1e-6
"""How far a stored range may be from ours, and one part in 2^23 of it besides, which is what
float32 keeps."""
MOST_PAIRS = 2_000_000_000
"""Rays times solids that are tried for one sample; of more, a random part of the rays is
audited."""


def ray_directions(lidar: Sensor, quaternion: Floats) -> Floats:
    """Unit vectors (*lidar.shape, 3) in the world, those of a raster written from docs/sensor.md
    and not from `lidarsim`. A table of rays is as it was given: from it there is nothing to
    derive."""
    body = _raster(lidar) if isinstance(lidar, Lidar) else lidar.directions_body
    w, u = quaternion[0], quaternion[1:]
    twice = 2.0 * np.cross(u, body)
    return np.asarray(body + w * twice + np.cross(u, twice))


def _raster(lidar: Lidar) -> Floats:
    """Unit vectors (rows, columns, 3) in the body frame."""
    rows = _angles(lidar.rows, lidar.vertical_fov_deg, full_turn=False)[:, None]
    a = _angles(
        lidar.columns, lidar.horizontal_fov_deg, full_turn=lidar.horizontal_fov_deg == 360.0
    )[None, :]
    pitch = math.radians(lidar.pitch_deg)
    e, tilt = (rows, pitch) if lidar.mount == "tilt" else (rows - pitch, 0.0)
    x, y, z = np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e) + 0.0 * a
    # R_y takes x to (cos, 0, -sin)
    return np.stack(
        [x * math.cos(tilt) + z * math.sin(tilt), y, z * math.cos(tilt) - x * math.sin(tilt)],
        axis=-1,
    )


def _angles(count: int, fov_deg: float, *, full_turn: bool) -> Floats:
    """Angles in radians, from minus half the field of view to plus half of it; a full turn leaves
    its end out."""
    if count == 1:
        return np.zeros(1)
    return np.radians(
        np.arange(count) * fov_deg / (count if full_turn else count - 1) - fov_deg / 2
    )


def audit(
    ranges: Field,
    position: Floats,
    quaternion: Floats,
    engine: Caster,
    lidar: Sensor,
    *,
    solids: int,
    rng: np.random.Generator,
) -> tuple[Ints, Floats, Floats]:
    """Cast the rays of one sample anew by `engine`, whose world has so many `solids`.

    Returns their numbers in C order, (n,); the ranges found, (n,) metres, inf where none; how far
    the stored ones are from them, (n,) metres, where no return counts as one from the end of the
    range.
    """
    directions = ray_directions(lidar, quaternion).reshape(-1, 3)
    chosen = np.arange(len(directions))
    most = max(MOST_PAIRS // max(solids, 1), 100)
    if len(chosen) > most:
        chosen = np.sort(rng.choice(chosen, most, replace=False))
    found = engine.cast(position[None], directions[None, chosen], lidar.max_range_m)[0]
    stored = np.minimum(ranges.reshape(-1)[chosen].astype(np.float64), lidar.max_range_m)
    return chosen, found, np.abs(stored - np.minimum(found, lidar.max_range_m))


def disagrees(gap: Floats, found: Floats, max_range_m: float) -> Mask:
    """Where the difference of two ranges is more than rounding makes, or is no number."""
    return ~(gap <= TOLERANCE_M + np.minimum(found, max_range_m) / 2**23)
